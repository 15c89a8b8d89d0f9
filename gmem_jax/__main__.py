"""`python -m gmem_jax`: the `gmem` command."""

from gmem_start import main

if __name__ == "__main__":
    main()
