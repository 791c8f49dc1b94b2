from sim34410.status import ErrorQueue, EventRegister


def test_errors_come_out_in_the_order_they_went_in():
    queue = ErrorQueue()
    for code in (-113, -222):
        queue.push(code)

    assert [queue.pop() for _ in range(3)] == ['-113,"Undefined header"', '-222,"Data out of range"', '+0,"No error"']


def test_the_twentieth_error_becomes_a_queue_overflow_when_one_more_comes():
    queue = ErrorQueue()
    for _ in range(20):
        queue.push(-113)
    queue.push(-222)
    queue.push(-222)
    codes = [queue.pop() for _ in range(21)]

    assert codes[:19] == ['-113,"Undefined header"'] * 19
    assert codes[19:] == ['-350,"Queue overflow"', '+0,"No error"']


def test_an_event_stays_until_it_is_read_and_only_a_rising_condition_makes_one():
    register = EventRegister()
    register.become(0b101)
    register.become(0b001)
    assert (register.condition, register.take(), register.take()) == (0b001, 0b101, 0)

    register.become(0b001)
    assert register.take() == 0


def test_the_summary_is_of_enabled_events():
    register = EventRegister()
    register.happened(0b10)

    assert not register.summary
    register.enable = 0b10
    assert register.summary
