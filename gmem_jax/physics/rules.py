"""Settings of JAX under which the package computes, whatever the user's are; and whether JAX starts."""

import contextlib
from collections.abc import Iterator

import jax


class StartError(RuntimeError):
    """JAX that does not start on this machine, or not with these settings."""


@contextlib.contextmanager
def usual_rules() -> Iterator[None]:
    """JAX's default rules of promotion and transfer, whatever a program asks of its own code; a decorator too.

    Under `jax_numpy_rank_promotion="raise"`, `jax_numpy_dtype_promotion="strict"` or a transfer guard a program is
    stopped where *it* mixes ranks or kinds of numbers, or moves arrays unasked. The package does so on purpose: a
    parameter [B] broadcasts against [N, 3, B], and what a run gives is brought to the host.
    """
    with (
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
        jax.transfer_guard("allow"),
    ):
        yield


def why_not_started() -> str:
    """Start JAX; return in one line why it does not start, or "" if it does."""
    try:
        jax.devices()
    except Exception as error:  # RuntimeError for an unknown platform, a bare AssertionError for one without a device
        said = " ".join(str(error).split()) or "there is no such device"
        platforms = getattr(jax.config, "jax_platforms", None)
        asked = f" with JAX_PLATFORMS={platforms}" if platforms else ""
        return f"JAX does not start{asked}: {said}; unset JAX_PLATFORMS, or set it to cpu"
    return ""


def require_started() -> None:
    """Start JAX.

    Raises:
        StartError: saying why it does not.
    """
    if why := why_not_started():
        raise StartError(why)
