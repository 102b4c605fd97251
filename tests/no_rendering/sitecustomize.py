"""On the path of a Python, hides from it every library that draws on a screen or writes films."""

import importlib.abc
import sys

HIDDEN = ("glfw", "OpenGL", "imageio", "imageio_ffmpeg", "mediapy", "pygame")


class Hidden(importlib.abc.MetaPathFinder):
    def find_spec(self, fullname, path=None, target=None):
        if fullname.split(".")[0] in HIDDEN:
            raise ModuleNotFoundError(f"No module named '{fullname}'", name=fullname)


sys.meta_path.insert(0, Hidden())
