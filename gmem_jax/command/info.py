"""The command `gmem info`."""

from typing import Any

from gmem_jax.command.console import AsJson, print_result
from gmem_jax.experiment.provenance import devices, is_one_cpu, provenance
from gmem_jax.files.cache import list_packs
from gmem_jax.native import build

if not is_one_cpu():
    import jax  # noqa: F401  under the rules that commands have for it


def info(as_json: AsJson = False) -> None:
    """Versions, devices, backend and shipped packs."""
    library, why = build.opened(build.HERE / build.LIBRARY)
    facts: dict[str, Any] = {
        **provenance(),
        "devices": devices(),
        "backend": f"native ({build.instruction_set(library)})" if library else f"jax (no native backend: {why})",
        "packs": list_packs(),
    }
    lines = [f"{key}: {value}" for key, value in facts["versions"].items()]
    lines += [f"commit: {facts['commit']}", f"backend: {facts['backend']}"]
    lines += [f"device: {device}" for device in facts["devices"]]
    lines += ["shipped packs: " + ", ".join(facts["packs"])]
    print_result(as_json, facts, "\n".join(lines))


COMMANDS = {"info": info}
