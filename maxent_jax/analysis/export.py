"""A policy as a program of its own, which runs where this package is not installed."""

import jax
import jax.numpy as jnp
from jax import export

from maxent_jax.sac import agent
from maxent_jax.sac.agent import Policy, Sac

PLATFORMS = ("cpu", "cuda", "tpu")


def policy(sac: Sac, policy: Policy, deterministic: bool = False) -> export.Exported:
    """A policy with its weights, for any number of states, on any of PLATFORMS.

    Its `call` takes (states [b, D] float32, a typed key), or states alone if it is deterministic,
    and gives actions [b, A] in [-1, 1]. `serialize()` gives bytes; `jax.export.deserialize` reads
    them where there are flatbuffers and this jax or, as jax promises for six months, a newer one.

    Args:
      policy: its weights, and the moments of its inputs.
      deterministic: the action at the mean of the Gaussian before the tanh, not one that is drawn.
    """
    states = jax.ShapeDtypeStruct((*export.symbolic_shape("b"), sac.observation_size), jnp.float32)
    key = jax.ShapeDtypeStruct((), jax.random.key(0).dtype)

    def draw(states, key):
        return agent.act(sac, policy, states, key)

    def mean(states):
        return agent.act(sac, policy, states, jax.random.key(0), deterministic=True)

    if deterministic:
        return export.export(jax.jit(mean), platforms=PLATFORMS)(states)
    return export.export(jax.jit(draw), platforms=PLATFORMS)(states, key)
