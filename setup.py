"""Builds the C++ search for nearest neighbours, where there is a compiler; else XLA does it."""

import importlib.util
import platform
from pathlib import Path

from setuptools import Extension, setup

# The file is compiled once for each; at run time the first that the processor can run is loaded.
X86_64 = {"v4": "-march=x86-64-v4", "v3": "-march=x86-64-v3"}
ARM64 = {"v8": "-march=armv8-a"}
MACHINES = {"x86_64": X86_64, "AMD64": X86_64, "aarch64": ARM64, "arm64": ARM64}
FLAGS = ["-std=c++17", "-O3", "-ffp-contract=fast", "-Wno-psabi", "-Wno-ignored-attributes"]


def extension(variant: str, architecture: str) -> Extension:
    jaxlib = Path(importlib.util.find_spec("jaxlib").origin).parent
    return Extension(
        f"maxent_jax.density._knn_{variant}",
        ["maxent_jax/density/knn.cc"],
        include_dirs=[str(jaxlib / "include")],
        extra_compile_args=[*FLAGS, architecture],
        optional=True,  # a machine without a compiler gets the package all the same
    )


variants = MACHINES.get(platform.machine(), {})
setup(
    options={"build_ext": {"parallel": True}},
    ext_modules=[extension(variant, flag) for variant, flag in variants.items()],
)
