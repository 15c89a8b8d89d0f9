"""Flags of XLA for programs that are small and run once."""

from importlib.metadata import version

# Much of the time of all tests is the compiler's, which makes programs fast. The emitters of fusions, which XLA can do
# without up to jaxlib 0.9, take half of the time that is left; an unknown flag ends the process. A program in one piece
# compiles in four fifths of the time that several take side by side, where workers have all cores already.
COMPILED_SOON = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
if version("jaxlib").startswith("0.9."):
    COMPILED_SOON += " --xla_cpu_use_fusion_emitters=false"
