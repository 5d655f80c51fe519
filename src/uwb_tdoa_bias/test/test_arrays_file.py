import io
import struct
import tracemalloc
import zipfile

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common import files
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import read_arrays

ARRAYS = {
    "a": np.arange(6.0).reshape(2, 3),
    "n": np.array(7),
    "t": np.array("hall"),
    "f": np.zeros((0, 3)),
}
KINDS = {"a": "f", "n": "i", "t": "U", "f": "f"}


def saved(function=np.savez, **changes):
    stream = io.BytesIO()
    function(stream, **{**ARRAYS, **changes})
    return stream.getvalue()


@pytest.fixture
def read(tmp_path):
    def read(content, kinds=KINDS):
        file = tmp_path / "file.npz"
        file.write_bytes(content)
        return read_arrays(file, kinds, "table", "make one")

    return read


@pytest.mark.parametrize("function", [np.savez, np.savez_compressed])
def test_what_numpy_wrote_comes_back(read, function):
    for name, array in read(saved(function, a=np.asfortranarray(ARRAYS["a"]))).items():
        np.testing.assert_array_equal(array, ARRAYS[name])
        assert array.dtype == ARRAYS[name].dtype and array.shape == ARRAYS[name].shape


def forged(shape="(10000000000,)", kind="<f8", body=bytes(8), compress=zipfile.ZIP_DEFLATED):
    """An .npz file whose array `a` claims a shape."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + body
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compress) as file:
        file.writestr("a.npy", data)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "File is not a zip file"),
        (b"something else", "File is not a zip file"),
        (saved()[:-30], "File is not a zip file"),
        (forged(), "a claims 80000000000 bytes, 8 are there"),
        (forged("(-1,)"), "a claims"),
        (forged("(1,)", "|O"), "a holds object"),
        (forged("(1,)", "<c8"), "a holds complex64"),
        (forged("'x'"), "shape"),
        (saved(a=np.array([1.0, np.nan])), "a holds NaN"),
        (saved(a=np.array(["x"], dtype=object)), "a holds object"),
        (saved(n=np.array(7.0)), "n holds float64"),
        (forged("(1"), "a has a header that cannot be read"),
        (forged("(1,)", "<U1", b"\xff\xff\xff\x7f"), "a holds no text"),
    ],
)
def test_refused_with_the_reason(read, content, said):
    with pytest.raises(InputError, match=rf"file\.npz: is no table \(.*{said}.*\); make one\."):
        read(content, {"a": "U" if "text" in said else "f"} if b"n.npy" not in content else KINDS)


def test_memory_is_not_taken_before_sizes_are_known(read, monkeypatch):
    monkeypatch.setattr(files, "ARRAYS_BYTES", 1_000_000)
    tracemalloc.start()
    with pytest.raises(InputError, match="more than 1000000 bytes"):
        read(forged("(20000000,)", body=bytes(160_000_000)), {"a": "f"})
    tracemalloc.reset_peak()
    with pytest.raises(InputError):
        read(forged(), {"a": "f"})
    assert tracemalloc.get_traced_memory()[1] < 200e6
    tracemalloc.stop()


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match=r"nowhere: is no table \(No such file or directory\)"):
        read_arrays(tmp_path / "nowhere", KINDS, "table", "make one")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.floats(0.0, 1.0, exclude_max=True), mask=st.integers(1, 255), packed=st.booleans())
def test_any_changed_byte_is_told_or_harmless(read, at, mask, packed):
    content = bytearray(saved(np.savez_compressed if packed else np.savez))
    content[int(at * len(content))] ^= mask
    try:
        read(bytes(content))
    except InputError:
        pass
