"""Sliders for what goes wrong."""

from __future__ import annotations

from typing import Any, NamedTuple

import viser

from d4orm_planners.play.session import Session


class SliderRange(NamedTuple):
    """Levels of one disturbance that a slider offers.

    Attributes:
        name: The disturbance and its attribute, as :func:`~d4orm_env.disturbances.disturbance_registry.find_level`
            knows them.
        label: Its name on the page, with its unit.
        low: Least level.
        high: Greatest level.
        step: Between levels.
        off: The level at which nothing goes wrong.
    """

    name: str
    label: str
    low: float
    high: float
    step: float
    off: float


SLIDERS = (
    SliderRange("control_noise", "Noise on controls", 0.0, 1.0, 0.02, 0.0),
    SliderRange("correlated_noise", "Slow noise on controls", 0.0, 1.0, 0.02, 0.0),
    SliderRange("bias", "Bias of controls", 0.0, 0.5, 0.01, 0.0),
    SliderRange("gain", "Gain of controls off by", 0.0, 0.8, 0.02, 0.0),
    SliderRange("quantisation", "Controls rounded to", 0.0, 1.0, 0.05, 0.0),
    SliderRange("delay", "Controls late [steps]", 0, 10, 1, 0),
    SliderRange("dropout", "Controls lost", 0.0, 0.95, 0.05, 0.0),
    SliderRange("state_noise", "Noise on positions seen [m]", 0.0, 0.2, 0.005, 0.0),
    SliderRange("state_delay", "States seen late [steps]", 0, 10, 1, 0),
    SliderRange("occlusion", "Sight [m]", 0.2, 10.0, 0.2, 10.0),
    SliderRange("push", "Pushes per robot [1/s]", 0.0, 2.0, 0.05, 0.0),
    SliderRange("stall", "Robots that stall", 0.0, 1.0, 0.05, 0.0),
    SliderRange("intruder", "Intruders", 0, 8, 1, 0),
    SliderRange("drag", "Drag [1/s]", 0.0, 2.0, 0.05, 0.0),
    SliderRange("limit_mismatch", "Limits are truly times", 0.3, 1.5, 0.05, 1.0),
)


class DisturbanceSliders:
    """Sliders that disturb a session from its next step on."""

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._session = session
        gui.add_markdown("From the next step on, the same for all that drive.")
        self.sliders: dict[str, Any] = {one.name: gui.add_slider(one.label, *one[2:5], one.off) for one in SLIDERS}
        for slider in self.sliders.values():
            slider.on_update(self._turn_by)
        gui.add_button("Nothing").on_click(lambda _: self._clear())

    def follow(self) -> None:
        """Show what the session is disturbed by."""
        for slider in SLIDERS:
            self.sliders[slider.name].value = self._session.levels.get(slider.name, slider.off)

    def _turn_by(self, event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
        if event.client is not None:  # a viewer's, not this program's
            self._turn()

    def _turn(self) -> None:
        self._session.disturb(
            {slider.name: value for slider in SLIDERS if (value := self.sliders[slider.name].value) != slider.off}
        )

    def _clear(self) -> None:
        for slider in SLIDERS:
            self.sliders[slider.name].value = slider.off
        self._turn()
