"""Damaged files, and arrays of any kind: read or refused in one line, never another exception."""

from pathlib import Path
from tempfile import TemporaryDirectory

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from test_read import MINARI, flat, read_or_refusal, split, write_hdf5, write_npz

from taic_jax.options.dataset import Experience


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, bytes]:
    """Return the bytes of a good file by suffix."""
    folder, arrays = tmp_path_factory.mktemp("whole"), flat([2, 3])
    files = write_npz(folder / "demos.npz", arrays), write_hdf5(folder / "demos.hdf5", split(arrays, [2, 3]))
    return {file.suffix: file.read_bytes() for file in files}


def read_bytes(suffix: str, content: bytes) -> Experience | str:
    with TemporaryDirectory() as folder:
        file = Path(folder) / f"demos{suffix}"
        file.write_bytes(content)
        return read_or_refusal(file)


@pytest.mark.parametrize("suffix", [".npz", ".hdf5"])
@given(share=st.floats(0, 1, exclude_max=True), tail=st.binary(max_size=64))
def test_refuses_torn_files(whole, suffix, share, tail):
    start = whole[suffix][: int(share * len(whole[suffix]))]
    for torn in (start, tail, whole[suffix][:8] + tail):
        assert isinstance(read_bytes(suffix, torn), str)


@given(where=st.floats(0, 1, exclude_max=True), value=st.integers(0, 255))
def test_reads_or_refuses_a_numpy_file_with_a_wrong_byte(whole, where, value):
    content = bytearray(whole[".npz"])
    content[int(where * len(content))] = value
    read_bytes(".npz", bytes(content))


@settings(max_examples=100)
@given(
    which=st.integers(0, 3),
    dtype=st.sampled_from(["?", "i1", "u8", "f2", "c8", "S3", "i4,f4"]),
    shape=st.sampled_from([(5,), (5, 2), (5, 3), (3,), (3, 2), (4, 3), (), (0,), (0, 2), (3, 2, 1)]),
)
def test_reads_or_refuses_arrays_of_any_kind(which, dtype, shape):
    arrays, array = flat([2, 3]), np.zeros(shape, dtype)
    tree = split(arrays, [2, 3])
    arrays[list(arrays)[which]] = tree["episode_1"][MINARI[which]] = array
    with TemporaryDirectory() as folder:
        read_or_refusal(write_npz(Path(folder) / "demos.npz", arrays))
        read_or_refusal(write_hdf5(Path(folder) / "demos.hdf5", tree))
