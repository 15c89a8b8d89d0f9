"""Better memories: the memory kernel of a pack, designed waveforms, tuned drives."""
