"""Builds the C++ of maxent_jax/native if there is a compiler; the package works without it."""

import copy
import importlib.util
import os
import shutil
import sysconfig
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

try:
    from setuptools.command.bdist_wheel import bdist_wheel
except ModuleNotFoundError:  # older than pyproject.toml asks for: enough for `build_ext --inplace`
    bdist_wheel = object

# The library is compiled once for each; at run time, the one that fits the processor is loaded.
X86_64 = {"v4": "-march=x86-64-v4", "v3": "-march=x86-64-v3"}
ARM64 = {"v8": "-march=armv8-a"}
MACHINES = {"x86_64": X86_64, "amd64": X86_64, "aarch64": ARM64, "arm64": ARM64}
FLAGS = ["-std=c++17", "-O3", "-g0", "-ffp-contract=fast", "-Wno-psabi"]
FLAGS += ["-Wno-ignored-attributes"]
NATIVE = Path("maxent_jax", "native")


def headers(package: str) -> str:
    """Returns the folder of the C headers in an installed package."""
    spec = importlib.util.find_spec(package)
    return str(Path(spec.origin).parent / "include")


def extension(variant: str, architecture: str) -> Extension:
    """Returns the library for one kind of processor."""
    return Extension(
        f"maxent_jax.native._{variant}",
        [str(NATIVE / name) for name in ("knn.cc", "physics.cc")],
        depends=[str(NATIVE / "parallel.h")],
        include_dirs=[str(NATIVE), headers("jaxlib"), headers("mujoco")],
        extra_compile_args=[*FLAGS, architecture],
        optional=True,  # a machine without a compiler still gets the package
    )


class BuildVariants(build_ext):
    """Builds the variants in parallel, each with its own object files: source names are equal."""

    def build_extension(self, ext: Extension) -> None:  # noqa: D102
        if ext is for_gpus:
            self.spawn(
                [*ext.extra_compile_args, *ext.sources, "-o", self.get_ext_fullpath(ext.name)]
            )
            return
        own = copy.copy(self)
        own.build_temp = str(Path(self.build_temp, ext.name))
        super(BuildVariants, own).build_extension(ext)

    def get_ext_filename(self, fullname: str) -> str:
        """Leaves out the tag of a Python version: ctypes loads the libraries, not Python."""
        return f"{Path(*fullname.split('.'))}.so"


class AnyPython(bdist_wheel):
    """Makes one wheel for every version of Python: the libraries do not depend on Python."""

    def get_tag(self) -> tuple[str, str, str]:  # noqa: D102
        return "py3", "none", super().get_tag()[2]


machine = sysconfig.get_platform().rsplit("-", 1)[-1].lower()
variants = MACHINES.get(machine, {})
which_runs = Extension(
    "maxent_jax.native._cpu",
    [str(NATIVE / "cpu.c")],
    extra_compile_args=["-O2", "-g0"],
    optional=True,
)
# For NVIDIA's GPUs, only if MAXENT_JAX_NVCC is set: the name or path of nvcc.
nvcc = shutil.which(os.environ.get("MAXENT_JAX_NVCC", ""))
for_gpus = Extension(
    "maxent_jax.native._cuda",
    [str(NATIVE / "knn.cu")],
    depends=[str(NATIVE / "knn_thread.h")],
    extra_compile_args=[
        *(str(nvcc), "-O3", "-std=c++17", "-shared", "-Xcompiler", "-fPIC", "-w"),
        # Code for Hopper; for later GPUs, code that the driver compiles.
        "-gencode=arch=compute_90,code=[sm_90,compute_90]",
        *("-I", str(NATIVE), "-I", headers("jaxlib")),
    ],
    optional=True,
)
setup(
    cmdclass={"build_ext": BuildVariants, "bdist_wheel": AnyPython},
    options={"build_ext": {"parallel": True}},
    ext_modules=[
        which_runs,
        *(extension(*variant) for variant in variants.items()),
        *([for_gpus] if nvcc else []),
    ],
)
