"""Changes of the mode, as the service passes them to guidance."""

from __future__ import annotations

import pytest

from companion.bench.lockstep_flight import plain_settings
from companion.guidance.interface import StreamStatus
from companion.perception.cameras import PerceptionCamera
from companion.service.inputs import InputAssembler
from companion.vehicle.state import FlightMode, VehicleState
from companion.vehicle.streamer import StreamState

UNNAMED, GUIDED = FlightMode.UNKNOWN, 4  # Copter's number


@pytest.mark.parametrize(
    ("before", "after", "changes"),
    [
        ((UNNAMED, 7), (UNNAMED, 11), 1),  # Copter's CIRCLE and DRIFT have no name here
        ((FlightMode.POSITION, 5), (FlightMode.POSITION, 16), 1),  # LOITER and POSHOLD have the same
        ((FlightMode.TAKEOFF, GUIDED), (FlightMode.HOLD, GUIDED), 0),  # two uses of GUIDED, both ours
        ((UNNAMED, 7), (UNNAMED, 7), 0),
    ],
)
def test_mode_changes_are_counted_by_their_number(
    before: tuple[FlightMode, int], after: tuple[FlightMode, int], changes: int
) -> None:
    settings = plain_settings()
    inputs = InputAssembler(settings, [PerceptionCamera(settings.of_camera(None))], lambda *_: None)

    def count(mode: FlightMode, number: int, *, armed: bool = True) -> int:
        state = VehicleState(mode=mode, custom_mode=number, armed=armed)
        inputs.on_state(state)
        return inputs.assemble(1, state, StreamStatus(StreamState.SILENT, 0)).mode_changes

    first = count(*before)
    assert count(*after) - first == changes
    assert count(*after, armed=False) - first == changes + 1
