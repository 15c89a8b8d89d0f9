"""gmem_jax: differentiable, batched simulation of waveform memory in granular packs."""
