"""An environment, a bonus, a method and a task as a user adds them, through the public API."""

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from maxent_jax import envs, intrinsic, tasks
from maxent_jax.config import register_method
from maxent_jax.density.histogram import Grid


class Point(Env):
    """A point in the plane that an action moves; it dies beyond a circle of radius 2."""

    def reset(self, rng):
        position = 0.1 * jax.random.normal(rng, (2,))
        return State(None, position, jnp.zeros(()), jnp.zeros(()), {}, {})

    def step(self, state, action):
        position = state.obs + 0.2 * action
        done = (jnp.sum(position**2) > 4.0).astype(jnp.float32)
        return state.replace(obs=position, done=done)

    @property
    def observation_size(self):
        return 2

    @property
    def action_size(self):
        return 2

    @property
    def backend(self):
        return "jax"


def far_from_origin(setting):
    """A bonus without a state: the distance from the origin."""
    del setting
    return intrinsic.Bonus(
        init=lambda key: jnp.zeros(()),
        reward=lambda state, steps: (state, jnp.sum(steps.next_features**2, axis=-1)),
    )


envs.register(
    "point",
    lambda backend, physics: Point(),
    Grid(names=("x", "y"), low=(-2.0, -2.0), high=(2.0, 2.0), bins=(20, 20)),
    in_metres=True,
)
intrinsic.register("far", far_from_origin)
register_method("newest", "last", 0, "mixture", "last", reward="linear")
tasks.register("right", lambda observation, action, next_observation: next_observation[..., 0])
tasks.register(
    "beyond",
    lambda observation, action, next_observation: (next_observation[..., 0] > 1).astype(
        jnp.float32
    ),
    sparse=True,
)
