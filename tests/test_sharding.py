"""The sharded search on eight simulated devices, in a process of its own: jax reads their number
once.
"""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from jax.sharding import Mesh

from maxent_jax.density.sharding import sharded_knn_distances

ON_EIGHT_DEVICES = """
import functools, itertools
import jax, numpy as np
from maxent_jax.density.knn import knn_distances
from maxent_jax.density.sharding import sharded_knn_distances

kinds = jax.sharding.AxisType
meshes = [jax.make_mesh((8,), ("devices",), axis_types=(x,)) for x in (kinds.Auto, kinds.Explicit)]
rng = np.random.default_rng(0)
for num_queries, num_points, k, count in ((64, 400, 3, None), (13, 401, 3, 390), (5, 11, 9, 10)):
    queries = rng.standard_normal((num_queries, 7), np.float32)
    points = rng.standard_normal((num_points, 7), np.float32)
    exclude = rng.integers(-1, num_points, num_queries).astype(np.int32)
    alone = knn_distances(queries, points, k, exclude, count)
    for mesh, shard in itertools.product(meshes, ("queries", "points")):
        search = functools.partial(sharded_knn_distances, k=k, mesh=mesh, axis="devices")
        search = jax.jit(functools.partial(search, shard=shard, exclude=exclude, count=count))
        found = search(queries, points)
        np.testing.assert_array_equal(found, alone)
        assert len(found.sharding.device_set) == 8
        if num_queries % 8 == 0:
            assert found.sharding.is_fully_replicated == (shard == "points")
print("equal on", jax.device_count())
"""


def test_eight_devices_find_what_one_does():
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8"
    found = subprocess.run(
        [sys.executable, "-c", ON_EIGHT_DEVICES],
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.stdout == "equal on 8\n", found.stderr


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"axis": "hosts"}, "no axis 'hosts'"),
        ({"shard": "features"}, "'queries' or 'points'"),
        ({"k": 5}, "number of points, 4"),
    ],
)
def test_what_cannot_be_shared_out_is_refused(change, message):
    mesh = Mesh(np.array(jax.devices()[:1]), ("devices",))
    settings = {"k": 1, "mesh": mesh, "axis": "devices"} | change
    with pytest.raises(ValueError, match=message):
        sharded_knn_distances(np.ones((2, 3), np.float32), np.ones((4, 3), np.float32), **settings)
