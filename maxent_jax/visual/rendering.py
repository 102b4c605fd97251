"""Draws states: a robot on an endless floor, seen by a camera that follows its torso.

The observation of MuJoCo's robots begins with the positions, so drawing needs no simulation.
"""

from pathlib import Path

import mujoco
import numpy as np

from maxent_jax.components import Components
from maxent_jax.envs.task import MujocoEnv
from maxent_jax.visual import headless
from maxent_jax.visual.headless import RenderingError

AZIMUTH, ELEVATION = 90.0, -20.0  # degrees: x to the right, y into the picture, slightly from above
DISTANCE = 2.3  # of the camera, in extents of the robot
FOG = (3.0, 12.0)  # where it begins and where it hides all, in extents: the floor ends in the sky
SQUARE = 1.0  # metres, the side of a square of the floor
SKY, ZENITH = (0.93, 0.95, 0.97), (0.70, 0.80, 0.90)
FLOOR = (0.80, 0.83, 0.86), (0.66, 0.70, 0.75)
AMBIENT, DIFFUSE = (0.45, 0.45, 0.45), (0.35, 0.35, 0.35)  # of the light at the camera


class Scene:
    """Draws one robot. A context manager, because it holds an OpenGL context.

    Args:
      xml: the robot's MJCF file.
      size: side of a picture, pixels.
    Raises:
      RenderingError: this machine cannot draw.
    """

    def __init__(self, xml: Path, size: int):
        headless.choose_backend()
        model = _model(xml, size)
        self._model, self._data = model, mujoco.MjData(model)
        self._torso = model.jnt_bodyid[0]
        self._camera = mujoco.MjvCamera()
        self._camera.azimuth, self._camera.elevation = AZIMUTH, ELEVATION
        self._camera.distance = DISTANCE * model.stat.extent
        self._renderer = mujoco.Renderer(model, size, size)
        flags = self._renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False  # slow without a GPU, as are reflections
        flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        flags[mujoco.mjtRndFlag.mjRND_FOG] = True

    def __enter__(self) -> "Scene":
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def draw(self, state: np.ndarray) -> np.ndarray:
        """Draws the robot in a state [D] that begins with its positions: [size, size, 3] uint8."""
        self._data.qpos[:] = state[: self._model.nq]
        mujoco.mj_forward(self._model, self._data)
        self._camera.lookat = self._data.xpos[self._torso]
        # MuJoCo lays out an endless plane around the camera's last place: move the camera first.
        mujoco.mjv_updateCamera(self._model, self._data, self._camera, self._renderer.scene)
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()


def scene(components: Components, size: int) -> Scene:
    """Makes the scene of a run's environment.

    Raises:
      RenderingError: it is not MuJoCo's, does not observe positions, or this machine cannot draw.
    """
    env = components.env.unwrapped
    if not isinstance(env, MujocoEnv) or env.observation_size < env.model.nq:
        raise RenderingError(
            f"environment '{components.config.env}' cannot be drawn: its observation does not "
            "begin with the positions of a MuJoCo model."
        )
    return Scene(env.task.xml, size)


def _model(xml: Path, size: int) -> mujoco.MjModel:
    """The file's model with our sky, light and endless planes: runs leave those of the XML."""
    spec = mujoco.MjSpec.from_file(str(xml))
    _hang_sky(spec)
    _lay_floor(spec)
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = AMBIENT, DIFFUSE
    spec.visual.rgba.fog = (*SKY, 1.0)
    spec.visual.map.fogstart, spec.visual.map.fogend = FOG
    spec.visual.global_.offwidth = spec.visual.global_.offheight = size
    return spec.compile()


def _hang_sky(spec: mujoco.MjSpec) -> None:
    skybox = mujoco.mjtTexture.mjTEXTURE_SKYBOX
    for texture in spec.textures:
        if texture.type == skybox:
            spec.delete(texture)
    spec.add_texture(
        name="maxent_sky",
        type=skybox,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=ZENITH,
        rgb2=SKY,
        width=256,
        height=6 * 256,
    )


def _lay_floor(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name="maxent_floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=FLOOR[0],
        rgb2=FLOOR[1],
        width=256,
        height=256,
    )
    # A repeat of the texture holds two squares each way, and texuniform counts repeats in 2 m.
    repeats = (1 / SQUARE, 1 / SQUARE)
    material = spec.add_material(name="maxent_floor", texuniform=True, texrepeat=repeats)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "maxent_floor"
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            geom.size[:2] = 0  # endless, to MuJoCo
            geom.material, geom.rgba = "maxent_floor", np.ones(4)
