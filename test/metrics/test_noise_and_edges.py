import math

import numpy as np
import pytest

from octn_ros.errors import QueryError
from octn_ros.metrics import edge_preservation_index, snr_db


def test_snr_by_hand():
    # Tissue of mean (0.4 + 0.6) / 2 = 0.5; air 0.1, 0.3: mean 0.2, variance 0.01. 10 log10(0.25 / 0.01) = 13.979 dB.
    assert snr_db(np.array([0.4, 0.6]), np.array([0.1, 0.3])) == pytest.approx(10 * math.log10(25.0))


def test_snr_does_not_depend_on_the_scale_of_the_display():
    generator = np.random.default_rng(1)
    tissue, air = generator.random((9, 9)), generator.random((5, 9))
    assert snr_db(255.0 * tissue, 255.0 * air) == pytest.approx(snr_db(tissue, air))


def test_snr_at_its_ends():
    assert snr_db(np.ones(3), np.full(4, 0.2)) == math.inf
    assert snr_db(np.zeros(3), np.array([0.0, 1.0])) == -math.inf


def test_snr_takes_integers_without_wrapping():
    assert snr_db(np.full(300, 255, np.uint8), np.array([0, 255], np.uint8)) == pytest.approx(10 * math.log10(4.0))


@pytest.mark.parametrize(
    ("tissue", "air"), [(np.ones(0), np.ones(4)), (np.ones(4), np.ones(1)), (np.ones(4), np.array([np.nan, 1.0]))]
)
def test_snr_refuses_regions_without_values(tissue, air):
    with pytest.raises(QueryError, match="snr_db: expected"):
        snr_db(tissue, air)


def test_epi_by_hand():
    # Columns along the beam: reference 0, 1, 1 and 0, 0, 2: axial steps 1 + 0 + 0 + 2 = 3.
    # Test 0, 0.5, 0.5 and 1, 1, 2: steps 0.5 + 0 + 0 + 1 = 1.5. EPI = 1.5 / 3.
    reference = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]])
    test = np.array([[0.0, 1.0], [0.5, 1.0], [0.5, 2.0]])
    assert edge_preservation_index(reference, test) == pytest.approx(0.5)


def test_epi_looks_along_the_beam_only_and_can_exceed_one():
    reference = np.linspace(0.0, 1.0, 6)[:, None] * np.ones(4)
    assert edge_preservation_index(reference, reference + np.arange(4.0)) == pytest.approx(1.0)
    assert edge_preservation_index(reference, 1.05 * reference) == pytest.approx(1.05)


@pytest.mark.parametrize(
    ("reference", "test"),
    [
        (np.eye(3), np.eye(4)),
        (np.eye(3)[:1], np.eye(3)[:1]),
        (np.ones((4, 4)), np.eye(4)),
        (np.eye(3), np.full((3, 3), np.nan)),
    ],
)
def test_epi_refuses_what_has_no_edges(reference, test):
    with pytest.raises(QueryError, match="edge_preservation_index: expected"):
        edge_preservation_index(reference, test)
