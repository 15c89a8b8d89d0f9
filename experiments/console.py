"""What the long scripts print."""


def say(what: str, _: float, fraction: float) -> None:
    """Progress in one line; a `gmem_jax.simulation.progress.Progress`."""
    print(f"\r{fraction:5.0%}  {what:24}", end="\n" if fraction >= 1.0 else "", flush=True)
