from collections import deque

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sim34410.memory import ReadingMemory

MEMORY_READINGS = 50_000

sizes = st.integers(0, 10) | st.integers(0, 3 * MEMORY_READINGS)


@given(st.lists(st.tuples(st.sampled_from(["append", "take", "clear"]), sizes), max_size=15))
def test_it_behaves_as_a_bounded_queue(actions):
    memory, model, counter = ReadingMemory(), deque(maxlen=MEMORY_READINGS), 0
    for action, size in actions:
        if action == "append":
            values = np.arange(counter, counter + size, dtype=float)
            counter += size
            lost = max(len(model) + size - MEMORY_READINGS, 0)
            model.extend(values)
            assert memory.append(values) == lost
        elif action == "take":
            expected = [model.popleft() for _ in range(min(size, len(model)))]
            assert memory.take(size).tolist() == expected
        else:
            memory.clear()
            model.clear()
        assert len(memory) == len(model)
        assert np.array_equal(memory.peek(), np.array(model))
