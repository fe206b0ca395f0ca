"""The flying event camera: renders along the way, finds the events, applies the faults."""

from typing import Any

import numpy as np

from envs.config import EnvConfig
from envs.events import EVENT, EventCamera
from envs.faults import add_background, dead_pixels, drop_dead
from envs.fidelity import choose_renderer, sub_renders
from envs.flight import Outcome, Point
from envs.scene import Scene


class Sensor:
    """Renderer, event camera and faults of one vehicle.

    Attributes:
        events: EVENT array of the last step, faults included.
        luminance: float32 (H, W), the last render.
        dropped: Events of the last step lost to the camera's cap.
        t_us: The simulated clock [us].
    """

    def __init__(self, config: EnvConfig) -> None:
        """Make the sensor that `config` describes."""
        self._config = config
        self._camera = EventCamera(config.camera)
        self._renderer: Any = None

    def reset(self, scene: Scene, place: Point, rng: np.random.Generator) -> None:
        """Look at a new scene from `place` (x, y) [m] at time 0; `rng` draws the faults. No events."""
        camera, self._rng = self._config.camera, rng
        self._set_renderer(scene)
        self._dead = dead_pixels((camera.height, camera.width), self._config.faults.sparsity, rng)
        self.t_us, self.dropped, self.events = 0, 0, np.empty(0, EVENT)
        self.luminance = self._render(*place)
        self._camera.reset(self.luminance, 0)

    def step(self, start: Point, outcome: Outcome, end_us: int) -> None:
        """Render the flown part of a control step in equal parts; set the events and the last render.

        Parts are never shorter than the clock's microsecond. A vehicle stopped by contact
        or goal stands still for the rest of the step and sees nothing new.

        Args:
            start: Where the step began, x and y [m].
            outcome: Where it ended.
            end_us: When the control step ends [us].

        Raises:
            ValueError: The renderer gave something that is not luminance.
        """
        start_us = self.t_us
        moving_us = round(outcome.flown * (end_us - start_us))
        way_m = outcome.flown * self._config.speed_mps / self._config.control_hz
        parts = min(sub_renders(way_m, self._config.renderer.max_step_m), moving_us) if moving_us else 0
        dx, dy = outcome.end[0] - start[0], outcome.end[1] - start[1]
        batches, self.dropped = [], 0
        for k in range(1, parts + 1):
            self.t_us = start_us + moving_us * k // parts
            self.luminance = self._render(start[0] + dx * (k / parts), start[1] + dy * (k / parts))
            batches.append(self._camera.step(self.luminance, self.t_us))
            self.dropped += self._camera.dropped
        self.t_us = end_us
        events = batches[0] if parts == 1 else np.concatenate((np.empty(0, EVENT), *batches))
        self.events = self._with_faults(events, start_us)

    def close(self) -> None:
        """Free the renderer."""
        close = getattr(self._renderer, "close", None)
        if close is not None:
            close()
        self._renderer = None

    def _with_faults(self, events: np.ndarray, start_us: int) -> np.ndarray:
        faults = self._config.faults
        if faults.sparsity > 0.0:
            events = drop_dead(events, self._dead)
        if faults.background_activity > 0.0 or faults.background_activity_hz > 0.0:
            events = add_background(events, start_us, self.t_us, faults, self._dead, self._rng)
        return events

    def _render(self, x_m: float, y_m: float) -> np.ndarray:
        return self._renderer.render(x_m, y_m, self._config.camera_height_m, 0.0, self.t_us * 1e-6)

    def _set_renderer(self, scene: Scene) -> None:
        """Keep the renderer from episode to episode if it can draw the new scene."""
        make = choose_renderer(self._config.renderer.name, scene)
        if type(self._renderer) is make:
            self._renderer.set_scene(scene)
            return
        self.close()
        camera = self._config.camera
        self._renderer = make(scene, camera.width, camera.height, camera.fov_deg)
