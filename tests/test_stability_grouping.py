"""Rows and medians by group, against numpy group by group."""

from __future__ import annotations

import numpy as np
import pytest

from improvo.errors import InputError
from improvo.stability.grouping import medians, rows_of


def test_medians_are_those_of_numpy() -> None:
    rng = np.random.default_rng(0)
    group = rng.integers(0, 12, 200)
    group[group == 5] = 6  # one group is empty
    values = rng.normal(size=200).astype(np.float32)
    values[rng.random(200) < 0.1] = np.nan
    found = medians(group, values, 12)
    for number in range(12):
        own = values[(group == number) & np.isfinite(values)].astype(np.float64)
        np.testing.assert_equal(found[number], np.median(own) if len(own) else np.nan)


def test_of_two_middle_values_the_median_is_their_mean() -> None:
    np.testing.assert_array_equal(medians(np.zeros(4, np.int64), np.array([4.0, 1.0, 2.0, 9.0]), 1), [3.0])


def test_no_values_have_no_median() -> None:
    assert np.isnan(medians(np.zeros(0, np.int64), np.zeros(0), 3)).all()
    assert np.isnan(medians(np.zeros(2, np.int64), np.array([np.nan, np.inf]), 1)).all()


def test_rows_of_ids_in_any_order() -> None:
    ids = np.array([40, 10, 30])
    np.testing.assert_array_equal(rows_of(ids, np.array([10, 40, 40, 30])), [1, 0, 0, 2])
    assert len(rows_of(ids, np.zeros(0, np.int64))) == 0
    for known, wanted in ((ids, [10, 20]), (ids, [50]), (np.zeros(0, np.int64), [0])):
        with pytest.raises(InputError, match=f"track {wanted[-1]} is in one table and not in the other"):
            rows_of(known, np.array(wanted))
