"""What a config makes once, and every step uses: the environment, the learner's fixed half, phi."""

import functools
from typing import NamedTuple

import jax

from maxent_jax import envs
from maxent_jax.config import Config
from maxent_jax.envs.task import MujocoEnv
from maxent_jax.features import FeatureMap, make_feature_map
from maxent_jax.sac import agent


class Parts(NamedTuple):
    """Static: nothing here changes in a run, or depends on a config's data fields."""

    config: Config
    env: MujocoEnv
    sac: agent.Sac
    phi: FeatureMap


def make(config: Config) -> Parts:
    """The parts of the config's program, made once for each program."""
    return _make(config.program())


@functools.lru_cache(maxsize=8)
def _make(config: Config) -> Parts:
    with jax.ensure_compile_time_eval():  # may be called first while something is being traced
        env = envs.make(
            config.env,
            config.backend,
            config.physics,
            torque_limit=config.torque_limit,
            end_flipped=config.end_flipped,
        )
        heading = config.policy_inputs == "heading"
        inputs = env.task.heading_inputs if heading else lambda observation: observation
        sac = agent.make(config, env.observation_size, env.action_size, inputs)
        return Parts(config, env, sac, make_feature_map(config.env))
