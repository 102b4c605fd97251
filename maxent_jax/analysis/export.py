"""Exports a policy as a program that runs without this package."""

import jax
import jax.numpy as jnp
from jax import export

from maxent_jax.sac import agent
from maxent_jax.sac.agent import Policy, Sac

PLATFORMS = ("cpu", "cuda", "tpu")


def policy(sac: Sac, trained: Policy, deterministic: bool = False) -> export.Exported:
    """Exports a policy with its weights, for any number of states, to any of PLATFORMS.

    The result's `call` takes (states [b, D] float32, typed key), or only states if it is
    deterministic, and returns actions [b, A] in [-1, 1]. `serialize()` gives bytes, which
    `jax.export.deserialize` reads. That needs flatbuffers and this version of jax, or a newer one;
    jax promises compatibility for six months.

    Args:
      trained: the policy's weights, and the moments of its inputs.
      deterministic: return the tanh of the Gaussian's mean instead of a draw.
    """
    states = jax.ShapeDtypeStruct((*export.symbolic_shape("b"), sac.observation_size), jnp.float32)
    key = jax.ShapeDtypeStruct((), jax.random.key(0).dtype)

    def draw(states, key):
        return agent.act(sac, trained, states, key)

    def mean(states):
        return agent.act(sac, trained, states, jax.random.key(0), deterministic=True)

    if deterministic:
        return export.export(jax.jit(mean), platforms=PLATFORMS)(states)
    return export.export(jax.jit(draw), platforms=PLATFORMS)(states, key)
