# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import threading

import pytest

from uwb_tdoa_tools.live.player import BATCH, BATCHES_AHEAD, read_ahead


@pytest.mark.parametrize("count", [0, 1, BATCH, 3 * BATCH + 7, BATCH * (BATCHES_AHEAD + 5)])
def test_items_come_complete_and_in_order(count):
    assert list(read_ahead(iter(range(count)))) == list(range(count))


def test_an_error_comes_after_the_items_before_it():
    def broken():
        yield from range(10)
        raise ValueError("worn out")

    seen = []
    with pytest.raises(ValueError, match="worn out"):
        for item in read_ahead(broken()):
            seen.append(item)
    assert seen == list(range(10))


def test_closing_early_ends_the_thread():
    before = threading.active_count()
    items = read_ahead(iter(range(10**9)))
    assert next(items) == 0
    items.close()
    assert threading.active_count() == before
