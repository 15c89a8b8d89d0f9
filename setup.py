"""Builds the optional native backend while the package is installed; everything else stands in pyproject.toml."""

import importlib.util
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

SOURCE = Path(__file__).parent / "gmem_jax" / "native" / "build.py"


def load_builder():
    """gmem_jax/native/build.py, without importing the package."""
    spec = importlib.util.spec_from_file_location("native_build", SOURCE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class BuildWithNative(build_py):
    """Compile the library beside the Python files; without a compiler say so and go on with plain JAX."""

    def run(self):
        """Copy the package, then build."""
        super().run()
        builder = load_builder()
        root = SOURCE.parent.parent.parent if self.editable_mode else Path(self.build_lib)
        library = root / "gmem_jax" / "native" / builder.LIBRARY
        if self.editable_mode and builder.opened(library)[0]:
            return  # a second environment of the same folder
        try:
            builder.build(library)
        except builder.BuildError as reason:
            print(f"gmem_jax: no native backend, plain JAX will be used: {reason}")


class OneWheel(bdist_wheel):
    """ctypes loads the library, which knows no Python: a wheel serves all versions."""

    def get_tag(self):
        """The platform's tag alone."""
        return "py3", "none", super().get_tag()[2]


class PlatformDistribution(Distribution):
    """The wheel holds a library: it belongs to one platform."""

    def has_ext_modules(self):
        """Always."""
        return True


setup(cmdclass={"build_py": BuildWithNative, "bdist_wheel": OneWheel}, distclass=PlatformDistribution)
