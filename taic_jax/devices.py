"""Many devices: the rows of a program (the seeds of all points), or its environments, over all that JAX sees.

They may belong to several hosts, each of which runs this program. All of them go through the same iterations and hold
the same results, which the first writes to a folder that all see; what one learns alone, as that it shall stop, it tells
the others.
"""

import os
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec

from taic_jax.config import Config, ConfigError, Shard
from taic_jax.envs.physics.mujoco import num_physical_cores

Tree = TypeVar("Tree")

SEEDS, ENVS = "seeds", "envs"
PATIENCE = 20.0
"""Seconds in which the first host must answer the others."""


class Hosts(NamedTuple):
    """Of a run over several hosts: where the first one can be reached, how many they are, and which this is."""

    coordinator: str = ""
    count: int = 1
    index: int = 0


ALONE = Hosts()


@dataclass(frozen=True)
class Devices:
    """What `--shard` asks for; `none` leaves every array and program on one device.

    Over `seeds`, each device runs the program on its part of the rows, and nothing is exchanged. Over `envs`, each
    device has all arrays and does all updates, but rolls out its part of the environments; one exchange a rollout.
    """

    shard: Shard = "none"

    @cached_property
    def mesh(self) -> Mesh:
        """The devices, along one axis with the name of what is split."""
        return jax.make_mesh((jax.device_count(),), (self.shard,), axis_types=(AxisType.Auto,))

    @property
    def _spec(self) -> Spec:
        return Spec(SEEDS) if self.shard == SEEDS else Spec()

    def place(self, rows: Tree) -> Tree:
        """Return rows where programs take them; the last one is repeated until all devices have as many."""
        if self.shard == "none":
            return rows
        if self.shard == SEEDS:
            rows = jax.tree.map(self._fill, rows)
        sharding = NamedSharding(self.mesh, self._spec)
        if jax.process_count() > 1:  # where `device_put` takes only devices of this host
            return jax.jit(lambda rows: rows, out_shardings=sharding)(rows)
        return jax.device_put(rows, sharding)

    def take(self, rows: Tree, count: int) -> Tree:
        """Return the first `count` rows, all but those that `place` added, on every host."""
        if jax.process_count() > 1:
            rows = jax.jit(lambda rows: rows, out_shardings=NamedSharding(self.mesh, Spec()))(rows)
            rows = jax.tree.map(_on_this_host, rows)
        return jax.tree.map(lambda x: x if len(x) == count else x[:count], rows)

    def compile(self, function: Callable, *args: Any, donate: bool = False) -> Callable:
        """Compile a function of rows and to rows for arguments that were placed; the first may be given away."""
        settings: dict[str, Any] = {"donate_argnums": 0 if donate else ()}
        if self.shard == "none":
            return jax.jit(function, **settings).lower(*args).compile()
        if self.shard == SEEDS:
            spec = self._spec
            function = jax.shard_map(function, mesh=self.mesh, in_specs=spec, out_specs=spec, check_vma=False)
        with jax.set_mesh(self.mesh):
            settings["out_shardings"] = NamedSharding(self.mesh, self._spec)
            return jax.jit(function, **settings).lower(*args).compile()

    def _fill(self, x: Any) -> Any:
        missing = -len(x) % self.mesh.size
        return x[np.minimum(np.arange(len(x) + missing), len(x) - 1)] if missing else x


def open_devices(shard: Shard, rows: int, hosts: Hosts = ALONE) -> Shard:
    """Have JAX take each physical core of a CPU for a device, no more than there are rows; return what to split.

    To be called before anything is computed. A number of devices that JAX was told is kept. Over several hosts, wait
    for the others.

    Raises:
      ConfigError: over several hosts nothing is to be split, or they cannot be reached.
    """
    told = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if shard != "none" and not told and jax.config.values["jax_num_cpu_devices"] < 1:
        cores = num_physical_cores()
        jax.config.update("jax_num_cpu_devices", cores if shard == ENVS else min(cores, -(-rows // hosts.count)))
    if hosts.count > 1:
        if shard == "none":
            raise ConfigError("--shard: expected what to split over the hosts, seeds or envs, got none")
        _join(hosts)
    if shard == "auto":
        alone = ENVS if hosts.count > 1 else "none"
        return SEEDS if min(rows, jax.device_count()) > 1 else alone
    return shard


def _join(hosts: Hosts) -> None:
    """Meet the other hosts at the first one.

    Raises:
      ConfigError: it does not answer, or not all come.
    """
    name, _, port = hosts.coordinator.rpartition(":")
    until = time.monotonic() + PATIENCE
    while hosts.index:
        try:
            socket.create_connection((name, int(port)), PATIENCE).close()
            break
        except OSError as error:
            if time.monotonic() > until:
                told = (
                    f"--hosts.coordinator: {hosts.coordinator} has not answered for {PATIENCE:.0f} s ({error.strerror})"
                )
                raise ConfigError(f"{told}; start host 0 there first") from None
            time.sleep(0.2)
    try:
        jax.distributed.initialize(hosts.coordinator, hosts.count, hosts.index)
    except RuntimeError as error:
        raise ConfigError(f"--hosts: {hosts.count} hosts did not meet at {hosts.coordinator}: {error}") from None


def make_devices(shard: Shard, config: Config) -> Devices:
    """Return the devices that the rows or the environments of a run are split over.

    Raises:
      ConfigError: environments do not divide by the devices.
    """
    count = jax.device_count()
    for name, ppo in (("collect", config.collect.ppo), ("train", config.train.ppo)):
        if shard == ENVS and ppo.num_envs % count:
            nearest = max(round(ppo.num_envs / count), 1) * count
            raise ConfigError(
                f"--shard envs: expected {name}.ppo.num_envs to be a multiple of the {count} devices, "
                f"got {ppo.num_envs}; the nearest valid value is {nearest}"
            )
    return Devices(shard)


def agree(numbers: Sequence[int], least: bool = False) -> list[int]:
    """Return the greatest of each number over all hosts, or the least; every host must ask."""
    if jax.process_count() == 1:
        return list(numbers)
    all_numbers = multihost_utils.process_allgather(np.asarray(numbers, np.int32))
    return (all_numbers.min(axis=0) if least else all_numbers.max(axis=0)).tolist()


def _on_this_host(x: jax.Array) -> Any:
    """Return an array that every device has, as one that is free to go to any."""
    x = x.addressable_data(0)
    if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(np.asarray(jax.random.key_data(x)), impl=jax.random.key_impl(x))
    return jax.numpy.asarray(np.asarray(x))


def over_envs(scan: Callable[[Any, Any], tuple[Any, Any]], num_envs: int) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Split a scan over ticks, (environments [B], [T, B]) -> ([B], [T, B]), where environments are split.

    The results are on all devices. What does not divide by them, as the episodes of an evaluation, each device does
    whole.
    """
    count = jax.sharding.get_abstract_mesh().shape.get(ENVS)
    if count is None:
        return scan
    axis = None if num_envs % count else ENVS
    specs = (Spec(axis), Spec(None, axis))
    split = jax.shard_map(scan, in_specs=specs, out_specs=specs, check_vma=False)
    return lambda state, inputs: jax.lax.with_sharding_constraint(split(state, inputs), Spec())
