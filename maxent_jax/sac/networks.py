"""Networks of policies, critics and bonuses: the only flax modules of the package."""

import jax
import jax.numpy as jnp
from flax import linen as nn

LOG_STD_RANGE = (-5.0, 2.0)  # of the Gaussian before the tanh


class Torso(nn.Module):
    """[..., I] -> [..., size]: ReLU layers of one size, layer norm before each ReLU if set."""

    num_layers: int
    size: int
    layer_norm: bool

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for _ in range(self.num_layers):
            x = nn.Dense(self.size)(x)
            if self.layer_norm:
                x = nn.LayerNorm()(x)
            x = nn.relu(x)
        return x


class Mlp(nn.Module):
    """[..., I] -> [..., O]: hidden ReLU layers of one size, and a linear output."""

    num_layers: int
    size: int
    output_size: int

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        x = Torso(self.num_layers, self.size, layer_norm=False)(inputs)
        return nn.Dense(self.output_size)(x)


class Trunk(nn.Module):
    """[..., I] -> [..., F] in [-1, 1]: one layer, normalised, tanh."""

    size: int

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        return nn.tanh(nn.LayerNorm()(nn.Dense(self.size)(inputs)))


class Actor(nn.Module):
    """[..., I] -> mean and log standard deviation of the action before its tanh, [..., A] each."""

    action_size: int
    num_layers: int
    size: int

    @nn.compact
    def __call__(self, inputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        x = Torso(self.num_layers, self.size, layer_norm=False)(inputs)
        mean, log_std = jnp.split(nn.Dense(2 * self.action_size)(x), 2, axis=-1)
        return mean, jnp.clip(log_std, *LOG_STD_RANGE)


class GaussianPolicy(nn.Module):
    """[..., I] -> mean, initially 0, and log standard deviation, equal in all states, [..., A]."""

    action_size: int
    num_layers: int
    size: int
    initial_log_std: float

    @nn.compact
    def __call__(self, inputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        x = Torso(self.num_layers, self.size, layer_norm=False)(inputs)
        mean = nn.Dense(self.action_size, kernel_init=nn.initializers.zeros)(x)
        initial = nn.initializers.constant(self.initial_log_std)
        log_std = self.param("log_std", initial, (self.action_size,))
        return mean, jnp.broadcast_to(log_std, mean.shape)


class Critic(nn.Module):
    """[..., I], [..., A] -> Q [..., 2] of two networks that share nothing."""

    num_layers: int
    size: int
    layer_norm: bool

    @nn.compact
    def __call__(self, inputs: jax.Array, action: jax.Array) -> jax.Array:
        x = jnp.concatenate([inputs, action], axis=-1)
        values = [
            nn.Dense(1)(Torso(self.num_layers, self.size, self.layer_norm)(x)) for _ in range(2)
        ]
        return jnp.concatenate(values, axis=-1)
