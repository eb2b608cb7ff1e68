"""Laws of packed infos: what goes in comes out, and the infos themselves stay as they are."""

import copy
import pickle

import numpy as np
import pytest

from bullet_tasks.infos import pack, unpack


def assert_same(a, b):
    assert list(a) == list(b), "keys in the same order"
    for key in a:
        assert type(a[key]) is type(b[key])
        if isinstance(a[key], np.ndarray):
            assert a[key].dtype == b[key].dtype and a[key].shape == b[key].shape
        assert np.array_equal(a[key], b[key])


POSITION = [np.array([0.1, i], np.float32) for i in range(3)]
CASES = {
    "arrays of one kind": ([{"a": True, "position": p, "b": i} for i, p in enumerate(POSITION)], {"position"}),
    "an image": ([{"image": np.full((2, 3, 4), i, np.uint8)} for i in range(3)], {"image"}),
    "two arrays": ([{"x": p, "y": p.astype(np.float64)} for p in POSITION], {"x", "y"}),
    "missing in one": ([{"position": POSITION[0]}, {}, {"position": POSITION[2]}], set()),
    "another shape": ([{"x": np.zeros(2)}, {"x": np.zeros(3)}], set()),
    "another type": ([{"x": np.zeros(2)}, {"x": np.zeros(2, np.float32)}], set()),
    "objects": ([{"x": np.array([None, i])} for i in range(2)], set()),
    "scalars": ([{"x": np.float32(i), "y": np.array(1.0)} for i in range(2)], set()),
    "no array": ([{"a": None, "b": "text"}] * 2, set()),
    "nothing": ([], set()),
}


@pytest.mark.parametrize("infos, stacked", CASES.values(), ids=CASES)
def test_what_goes_in_comes_out(infos, stacked):
    before = copy.deepcopy(infos)
    packed = pack(infos)
    assert packed.columns.keys() == stacked
    for a, b in zip(infos, before, strict=True):
        assert_same(a, b)
    out = unpack(pickle.loads(pickle.dumps(packed)))
    assert len(out) == len(before)
    for a, b in zip(out, before, strict=True):
        assert_same(a, b)


def test_packing_pays():
    infos = [{"is_success": False, "position": np.array([0.1, i], np.float32)} for i in range(32)]
    assert len(pickle.dumps(pack(infos))) < 0.5 * len(pickle.dumps(infos))
