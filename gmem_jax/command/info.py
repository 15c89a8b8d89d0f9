"""`gmem info`."""

from typing import Any

import jax

from gmem_jax import native
from gmem_jax.command.console import AsJson, print_result
from gmem_jax.experiment.provenance import provenance
from gmem_jax.files.cache import list_packs


def info(as_json: AsJson = False) -> None:
    """Versions, devices, backend and shipped packs."""
    built, why = native.available()
    facts: dict[str, Any] = {
        **provenance(),
        "devices": [f"{d.platform}: {d.device_kind}" for d in jax.devices()],
        "backend": f"native ({why})" if built else f"jax (no native backend: {why})",
        "packs": list_packs(),
    }
    lines = [f"{key}: {value}" for key, value in facts["versions"].items()]
    lines += [f"commit: {facts['commit']}", f"backend: {facts['backend']}"]
    lines += [f"device: {device}" for device in facts["devices"]]
    lines += ["shipped packs: " + ", ".join(facts["packs"])]
    print_result(as_json, facts, "\n".join(lines))


COMMANDS = {"info": info}
