"""Files: packs, recalls, waveforms, finished parts of long runs, and where a result came from."""
