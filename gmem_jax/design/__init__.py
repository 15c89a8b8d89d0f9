"""Memory kernels of packs, inverse design of waveforms, and tuning of parameters."""
