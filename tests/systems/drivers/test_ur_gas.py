"""Gas flows before the torch and after it, by the controller's time."""

from weldcal.systems.drivers.ur.set_points import ArcInputs, Gas


def run(gas: Gas, wanted: list[bool]) -> list[tuple[bool, bool]]:
    """(valve, torch) at steps of 0.1 s."""
    return [gas.step(0.1 * k, on) for k, on in enumerate(wanted)]


def test_the_torch_waits_for_the_gas_and_the_gas_outlasts_the_torch() -> None:
    found = run(Gas(0.25, 0.35), [False] * 2 + [True] * 6 + [False] * 6)
    assert [valve for valve, _ in found] == [False] * 2 + [True] * 6 + [True] * 3 + [False] * 3
    assert [torch for _, torch in found] == [False] * 5 + [True] * 3 + [False] * 6


def test_a_torch_that_comes_back_while_gas_flows_does_not_wait() -> None:
    found = run(Gas(0.25, 0.55), [True] * 5 + [False] * 2 + [True])
    assert found[-1] == (True, True)


def test_gas_that_was_off_flows_anew_before_the_torch() -> None:
    found = run(Gas(0.25, 0.0), [True] * 5 + [False] * 2 + [True])
    assert [valve for valve, _ in found[5:]] == [False, False, True]
    assert found[-1] == (True, False)


def test_inputs_are_read_from_the_controllers_bits() -> None:
    assert (ArcInputs().wired, ArcInputs().arc(0xFF), ArcInputs().fault(0xFF)) == (False, None, False)
    wired = ArcInputs(established=3, arc_fault=5)
    assert (wired.arc(1 << 3), wired.fault(1 << 3)) == (True, False)
    assert (wired.arc(1 << 5), wired.fault(1 << 5)) == (False, True)
