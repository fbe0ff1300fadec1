"""Many devices: splits of a program's rows (the seeds of all points), or of its environments, over JAX's devices."""

import contextlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec

from taic_jax.config import Config, ConfigError, Shard, settings_of
from taic_jax.envs.physics.mujoco import num_physical_cores
from taic_jax.runtime.hosts import ALONE, Hosts, join, on_this_host
from taic_jax.runtime.program_cache import compiler_options

Tree = TypeVar("Tree")

SEEDS, ENVS = "seeds", "envs"


@dataclass(frozen=True)
class Devices:
    """The devices of `--shard`; `none` leaves every array and program on one device.

    Over `seeds`, each device runs the program on its part of the rows, without exchange. Over `envs`, each device has
    all arrays and does all updates, but rolls out its part of the environments, with one exchange a rollout.
    """

    shard: Shard = "none"

    @cached_property
    def mesh(self) -> Mesh:
        """The devices, along one axis, named `seeds` or `envs`."""
        return jax.make_mesh((jax.device_count(),), (self.shard,), axis_types=(AxisType.Auto,))

    @property
    def _spec(self) -> Spec:
        return Spec(SEEDS) if self.shard == SEEDS else Spec()

    def place(self, rows: Tree) -> Tree:
        """Move rows onto the devices, and repeat the last one until all devices have equally many."""
        if self.shard == "none":
            return rows
        if self.shard == SEEDS:
            rows = jax.tree.map(self._fill, rows)
        return self._send(rows, self._spec)

    def take(self, rows: Tree, count: int) -> Tree:
        """Return the first `count` rows, without those that `place` added, on one device of every host.

        Otherwise every later computation, even a slice, would run on all devices and exchange its inputs; on a CPU
        many such small programs at once can take all threads, and then wait for each other for ever.
        """
        if jax.process_count() > 1:
            rows = jax.tree.map(on_this_host, self._send(rows, Spec()))
        elif self.shard != "none":
            rows = jax.device_put(rows, jax.local_devices()[0])
        return jax.tree.map(lambda x: x if len(x) == count else x[:count], rows)

    def compile(self, function: Callable, *args: Any, donate: bool = False) -> Callable:
        """Compile a function from rows to rows for placed arguments; the first may be donated."""
        settings: dict[str, Any] = {"donate_argnums": 0 if donate else ()}
        split, spec = self.shard != "none", self._spec
        if self.shard == SEEDS:
            function = jax.shard_map(function, mesh=self.mesh, in_specs=spec, out_specs=spec, check_vma=False)
        if split:
            settings["out_shardings"] = NamedSharding(self.mesh, spec)
        with jax.set_mesh(self.mesh) if split else contextlib.nullcontext():
            return jax.jit(function, **settings).lower(*args).compile(compiler_options=compiler_options())

    def _send(self, rows: Tree, spec: Spec) -> Tree:
        sharding = NamedSharding(self.mesh, spec)
        if jax.process_count() > 1:  # then `device_put` takes only devices of this host
            return jax.jit(_same, out_shardings=sharding)(rows)
        return jax.device_put(rows, sharding)

    def _fill(self, x: Any) -> Any:
        missing = -len(x) % self.mesh.size
        return x[np.minimum(np.arange(len(x) + missing), len(x) - 1)] if missing else x


def _same(rows: Tree) -> Tree:
    """Return rows unchanged; a lambda in each call would be compiled each time."""
    return rows


def open_devices(shard: Shard, rows: int, hosts: Hosts = ALONE) -> Shard:
    """Make each physical core of a CPU a device, or fewer if the rows need fewer; return the resolved `shard`.

    Call it before any computation. JAX's own setting of the number of devices prevails. Connect to the other hosts, or
    raise ConfigError.
    """
    is_set = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if shard != "none" and not is_set and jax.config.values["jax_num_cpu_devices"] < 1:
        cores = num_physical_cores()
        jax.config.update("jax_num_cpu_devices", cores if shard == ENVS else fewest(-(-rows // hosts.count), cores))
    if hosts.count > 1:
        join(hosts)
    if shard == "auto":
        alone = ENVS if hosts.count > 1 else "none"
        return SEEDS if min(rows, jax.device_count()) > 1 else alone
    return shard


def fewest(rows: int, cores: int) -> int:
    """Return the fewest devices, each a core, that have as few rows each as with all cores: of ten rows on eight, 5."""
    return -(-rows // -(-rows // cores))


def make_devices(shard: Shard, config: Config) -> Devices:
    """Return the devices of a run, or raise ConfigError if its environments do not divide by them."""
    count = jax.device_count()
    for name, group in (("collect", config.collect), ("train", config.train)):
        num_envs = settings_of(group).num_envs
        if shard == ENVS and num_envs % count:
            valid = f"the nearest valid value is {max(round(num_envs / count), 1) * count}"
            expected = f"expected {name}.{group.learner}.num_envs to be a multiple of the {count} devices"
            raise ConfigError(f"--shard envs: {expected}, got {num_envs}; {valid}")
    return Devices(shard)


def over_envs(scan: Callable[[Any, Any], tuple[Any, Any]], num_envs: int) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Split a scan over ticks, (environments [B], [T, B]) -> ([B], [T, B]), over the devices of `--shard envs`.

    The results are on all devices. If the environments do not divide by the devices, each device scans all.
    """
    count = jax.sharding.get_abstract_mesh().shape.get(ENVS)
    if count is None:
        return scan
    axis = None if num_envs % count else ENVS
    specs = (Spec(axis), Spec(None, axis))
    split = jax.shard_map(scan, in_specs=specs, out_specs=specs, check_vma=False)
    return lambda state, inputs: jax.lax.with_sharding_constraint(split(state, inputs), Spec())
