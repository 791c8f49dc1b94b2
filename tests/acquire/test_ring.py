from collections import deque

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from aemd.acquire.ring import Ring
from aemd.block import make_block


class RingAgainstDeque(RuleBasedStateMachine):
    """Whatever is pushed and popped, the ring holds what a deque of the same history holds."""

    def __init__(self) -> None:
        super().__init__()
        self.ring = Ring(16)
        self.model: deque[tuple[int, int, float, int]] = deque()
        self.next_index = 0

    @rule(count=st.integers(0, 20))
    def push(self, count: int) -> None:
        block = make_block(np.arange(count) * 0.5, first_index=self.next_index, t0_ns=7, interval_ns=3, status=count)
        if count > 16 - len(self.model):
            with pytest.raises(ValueError, match="room for"):
                self.ring.push(block)
        else:
            self.ring.push(block)
            self.model.extend(block.tolist())
            self.next_index += count

    @rule(most=st.integers(0, 20))
    def pop(self, most: int) -> None:
        expected = [self.model.popleft() for _ in range(min(most, len(self.model)))]

        assert self.ring.pop(most).tolist() == expected

    @invariant()
    def counts_agree(self) -> None:
        assert self.ring.waiting == len(self.model)
        assert self.ring.free == 16 - len(self.model)
        assert self.ring.pushed == self.next_index
        assert self.ring.popped == self.next_index - len(self.model)


TestRingAgainstDeque = RingAgainstDeque.TestCase
TestRingAgainstDeque.settings = settings(deadline=None, derandomize=True)


@pytest.mark.parametrize("capacity", [0, -4, 3, 1000])
def test_a_capacity_that_is_not_a_power_of_two_is_refused(capacity: int) -> None:
    with pytest.raises(ValueError, match=f"ring of {capacity} readings: must be a power of two"):
        Ring(capacity)


def test_a_popped_block_keeps_its_values_when_the_ring_is_written_again() -> None:
    ring = Ring(4)
    ring.push(make_block([1.0, 2.0, 3.0, 4.0]))
    block = ring.pop(4)
    ring.push(make_block([5.0, 6.0, 7.0, 8.0]))

    assert block["value_V"].tolist() == [1.0, 2.0, 3.0, 4.0]
