"""Wrong arguments of the Python API: one sentence each, of the class that its place has."""

import pytest

from benchmarks.faults import api


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    return api.places(tmp_path_factory.mktemp("api"))


@pytest.mark.parametrize("fault", api.FAULTS, ids=lambda fault: fault.what.replace("\0", "0"))
def test_a_wrong_argument_is_one_sentence(places, fault):
    assert not api.meet(fault, places)


def test_a_fault_that_is_not_met_is_noticed(places):
    accepted = api.of(lambda _: None, ValueError, "")
    other_class = api.of(lambda _: {}["a"], ValueError, "")
    other_words = api.of(lambda _: int("a"), ValueError, "no such words")
    for fault in (accepted, other_class, other_words):
        assert api.meet(fault, places)
