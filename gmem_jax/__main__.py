"""`python -m gmem_jax`: the `gmem` command."""

from gmem_jax.command.app import main

if __name__ == "__main__":
    main()
