"""One run over several hosts, each of which runs this program.

All compute the same iterations and results, and the first writes the results to a folder that all see. `agree` sends
the news of one host, such as a signal to stop, to all.
"""

import signal
import socket
import sys
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils

from taic_jax.config import ConfigError

PATIENCE = 20.0  # seconds for the first host to answer the others
FOREVER = 10**6  # seconds that JAX waits for the last host; afterwards it prints a stack of C++ instead of an error


class Hosts(NamedTuple):
    """The hosts of a run: the first one's HOST:PORT, their number, and the index of this one."""

    coordinator: str = ""
    count: int = 1
    index: int = 0


ALONE = Hosts()


def join(hosts: Hosts) -> None:
    """Connect to the other hosts, however late the last; raise ConfigError if the first is silent or refuses this."""
    if hosts.index:
        _await_answer(hosts.coordinator)
    else:
        print(f"taic_jax: waiting for {hosts.count - 1} more hosts at {hosts.coordinator}", file=sys.stderr)
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)  # Python's would wait until JAX returns
    try:
        jax.distributed.initialize(hosts.coordinator, hosts.count, hosts.index, initialization_timeout=FOREVER)
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"--hosts: {hosts.count} did not meet at {hosts.coordinator}: {reason}") from None
    finally:
        signal.signal(signal.SIGINT, before)


def _await_answer(address: str) -> None:
    host, _, port = address.rpartition(":")
    until = time.monotonic() + PATIENCE
    while True:
        try:
            socket.create_connection((host, int(port)), PATIENCE).close()
            return
        except OSError as error:
            if time.monotonic() > until:
                reason = f"has not answered for {PATIENCE:.0f} s ({error.strerror or error})"
                raise ConfigError(f"--coordinator: {address} {reason}; host 0 is to be started there") from None
        time.sleep(0.2)


def agree(numbers: Sequence[int], least: bool = False) -> list[int]:
    """Return the greatest of each number over all hosts, or the least; every host must ask."""
    if jax.process_count() == 1:
        return list(numbers)
    all_numbers = multihost_utils.process_allgather(np.asarray(numbers, np.int32))
    return (all_numbers.min(axis=0) if least else all_numbers.max(axis=0)).tolist()


def on_this_host(x: jax.Array) -> Any:
    """Return a copy of a replicated array that is committed to no device."""
    x = x.addressable_data(0)
    if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.asarray(np.asarray(jax.random.key_data(x))), impl=jax.random.key_impl(x))
    return jnp.asarray(np.asarray(x))
