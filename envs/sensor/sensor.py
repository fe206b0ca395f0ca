"""The vehicle's event camera: render along the way, find the events, apply the faults."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from envs.checks import check_pose
from envs.config import WITHOUT_EVENTS, EnvConfig, FaultsConfig
from envs.events import EVENT, EventCamera, RealSensor
from envs.events.faults import NO_FAULTS, FaultState, check_expected, has_readout
from envs.events.flicker import NO_FLICKER, brightness_at, draw_flicker, looks_needed
from envs.events.lowpass import UNLIMITED
from envs.events.ramps import ColumnCamera
from envs.fidelity import RenderPlan, make_renderer, plan_renders, sub_renders
from envs.kinematics import Point
from envs.raycast.noise import NO_NOISE
from envs.raycast.records import BODY, FRAME
from envs.raycast.silhouettes import Way
from envs.raycast.stretches import Shifts
from envs.scene import MovingBody, Scene
from envs.sensor.looks import BAD_POSE, View, scratch_for

FAULTLESS = FaultsConfig()
MAX_PIXELS_TOGETHER = 2**22  # pixels rendered before the camera sees them: 16 MiB


class Sensor:
    """Renderer, event camera and faults of one vehicle.

    It simulates only what is observed. With observation "luminance" it renders once a step, without an event
    camera; with "none" it only advances the clock.

    A sensor with adaptive column rendering (`sees_by_looks`) is not stepped here. The compiled step of
    `envs.vehicles` takes its `view` and `faults`, together with the views and faults of many other sensors.
    `with_faults` then applies the faults that the compiled step cannot.

    Attributes:
        events: EVENT array of the last step, faults included; empty if no event camera is simulated.
        true_events: The events before the faults.
        luminance: float32 (H, W), the last render; with `sees_by_looks`, the next step changes this array.
        dropped: Events of the last step lost to the camera's cap and its readout.
        renders: Number of renders in the last step.
        t_us: The simulated clock [us].
        plan: Rendering settings of the scene, `envs.fidelity.RenderPlan`.
    """

    def __init__(self, config: EnvConfig, planned: EnvConfig | None = None) -> None:
        """Make the sensor that `config` describes.

        Its renders are planned for the speed and rate of `planned`. These differ from `config` if the vehicle
        may fly faster than `config.speed_mps`. None: use `config`.
        """
        self._config, self._planned = config, planned or config
        self._camera: Any = EventCamera(config.camera)  # a `ColumnCamera` if `plan.by_looks`
        self._together = max(1, MAX_PIXELS_TOGETHER // (config.camera.width * config.camera.height))
        self._renderer: Any = None
        self._pictures_alone = config.observation == "luminance"
        self._seen_us = np.zeros(config.camera.width, np.int64)
        self._flicker = NO_FLICKER
        self._way: tuple[np.ndarray, float] | None = None  # way of the last step, and the share travelled
        self.true_events = np.empty(0, EVENT)
        self.plan: RenderPlan

    def reset(self, scene: Scene, place: Point, rng: np.random.Generator, t_us: int = 0) -> None:
        """Start in a new scene at `place` (x, y) [m]; there are no events yet. `rng` draws the faults."""
        camera = self._config.camera
        self.t_us, self.dropped, self.renders, self.events = t_us, 0, 0, np.empty(0, EVENT)
        if self._config.observation == "none":
            self.luminance = np.zeros((camera.height, camera.width), np.float32)
            return
        self._set_renderer(scene)
        self._flicker = NO_FLICKER if self._pictures_alone else draw_flicker(self._config.faults, rng)
        self.luminance = self._picture(place, t_us)
        if not self._pictures_alone:
            self._seen_us[:] = t_us
            if self.plan.by_looks:
                self._camera.reset(self.luminance)
                self.luminance = self._camera.last_frame
            else:
                self._camera.reset(self.luminance, t_us)
            state = self._camera.state, self._camera.pixels
            self._real = RealSensor(camera, self._config.faults, state, rng, t_us)

    def step(self, start: Point, end: Point, share: float, end_us: int, way: np.ndarray | None) -> None:
        """Simulate one control step from whole images: render along the way and set the events.

        The parts between renders last at least one microsecond. A vehicle stopped by contact or goal stands
        still for the rest of the step and sees nothing new. Without an event camera, only the end of the
        motion is rendered.

        Args:
            start: Position at the start of the step, x and y [m].
            end: Position at the end of the step, x and y [m].
            share: Share of the step in which the vehicle moved.
            end_us: End of the control step [us].
            way: (N + 1, 2), the planned places at the ends of N parts of the step, of equal time [m]; None if
                the way is straight.

        Raises:
            ValueError: The renderer returned something that is not luminance.
        """
        if self._config.observation == "none":
            self.t_us = end_us
            return
        start_us = self.t_us
        moving_us = round(share * (end_us - start_us))
        if self._pictures_alone:
            self.renders = int(moving_us > 0)
            if self.renders:
                self.luminance = self._picture(end, start_us + moving_us)
            self.t_us = end_us
            return
        self._way = None if way is None else (way, share)
        way_m = share * self._config.speed_mps / self._config.control_hz
        if way is not None:
            way_m = share * float(np.hypot(*np.diff(way, axis=0).T).sum())
        renders = sub_renders(way_m, self.plan.max_step_m)
        if self._config.camera.memory == "reference":
            renders = max(renders, looks_needed(self._flicker, moving_us))
        self.renders = min(renders, moving_us)
        events = self._render_along(start, end, moving_us)
        self.t_us = end_us
        self.events = self.with_faults(events, start_us, end_us)
        self.dropped += self.lost

    def move_bodies(self, moving: Sequence[MovingBody], start_s: float, end_s: float) -> None:
        """Move the scene's moving bodies straight from their places at `start_s` to those at `end_s` [s]."""
        if self._config.observation != "none":
            self._renderer.move_bodies(moving, start_s, end_s)

    @property
    def sees_by_looks(self) -> bool:
        """Whether the compiled step simulates this sensor (adaptive column rendering)."""
        return self._config.observation not in WITHOUT_EVENTS and self.plan.by_looks

    @property
    def has_faults(self) -> bool:
        """Whether `with_faults` changes anything."""
        return self._config.faults != FAULTLESS or has_readout(self._config.camera)

    @property
    def lost(self) -> int:
        """Return the number of events of the last step that the readout lost."""
        return self._real.lost

    def view(self) -> View:
        """Return the arrays for the compiled step; without a scene if it does not simulate this sensor."""
        scene = np.empty(0, BODY), NO_NOISE, np.zeros(1, FRAME), 0.0
        bandwidth, shifts = UNLIMITED, Shifts(1.0, 1.0, 1.0)
        if self.sees_by_looks:
            renderer, bandwidth, shifts = self._renderer, self._camera.bandwidth, self.plan.max_shifts_px
            scene = renderer.bodies, renderer.noise, renderer.frame, renderer.cull_m
        model, memory, _ = self._camera.state
        camera = self._config.camera
        size = (camera.width, camera.height) if self.sees_by_looks else (2, 2)  # numba types 1 differently
        scratch = scratch_for(*size, len(scene[0]))
        return View(*scene, model, memory, self._seen_us, bandwidth, shifts, self._flicker, scratch)

    def faults(self) -> FaultState:
        """Return the faults that the compiled step applies to this sensor's events."""
        is_compiled = self.has_faults and self.sees_by_looks and self._real.is_compiled
        return self._real.state if is_compiled else NO_FAULTS

    @property
    def needs_python(self) -> bool:
        """Whether the compiled step leaves work for `step` or `with_faults`."""
        return not self.sees_by_looks or (self.has_faults and not self._real.is_compiled)

    def check_faults(self, start_us: int, end_us: int) -> None:
        """Raise ValueError if more false events were expected in the last step than the limit allows."""
        check_expected(self._real.state, (start_us, end_us))

    def with_faults(self, events: np.ndarray, start_us: int, end_us: int) -> np.ndarray:
        """Apply this sensor's faults to the events of a step."""
        self.true_events = events
        return self._real.events(events, start_us, end_us) if self.has_faults else events

    def _render_along(self, start: Point, end: Point, moving_us: int) -> np.ndarray:
        """Return the events along a way, from renders of whole images."""
        start_us = self.t_us
        batches, self.dropped = [], 0
        for first in range(0, self.renders, self._together):
            part = np.arange(first + 1, min(first + self._together, self.renders) + 1)
            times = start_us + moving_us * part // self.renders
            frames = self._flickering(
                self._renderer.render_way(self._poses(start, end, part / self.renders, times)), times
            )
            batches.append(self._camera.steps(frames, times.tolist()))
            self.luminance, self.dropped = frames[-1], self.dropped + self._camera.dropped
        return batches[0] if len(batches) == 1 else np.concatenate((np.empty(0, EVENT), *batches))

    def _picture(self, place: Point, t_us: int) -> np.ndarray:
        """Render luminance from a place (x, y) [m] at a time, float32 (H, W)."""
        poses = self._poses(place, place, np.ones(1), np.array([t_us]))
        picture = self._flickering(self._renderer.render_way(poses), np.array([t_us]))[0]
        if not (picture.min() >= 0.0 and picture.max() < np.inf):
            raise ValueError("luminance must be finite and >= 0; the renderer gave something else")
        return picture

    def _flickering(self, frames: np.ndarray, times_us: np.ndarray) -> np.ndarray:
        """Return frames, float32 (K, H, W), multiplied by the flickering light at their times."""
        if self._flicker.depth == 0.0:
            return frames
        lit: np.ndarray = frames * brightness_at(self._flicker, times_us)[:, None, None]
        return lit

    def close(self) -> None:
        """Free the renderer."""
        close = getattr(self._renderer, "close", None)
        if close is not None:
            close()
        self._renderer = None

    def _poses(self, start: Point, end: Point, part: np.ndarray, t_us: np.ndarray) -> np.ndarray:
        """Return x, y, z [m], yaw [rad] and time [s] at each share `part` of the way, (K, 5)."""
        poses = np.zeros((part.size, 5))
        if self._way is None:
            poses[:, 0] = start[0] + (end[0] - start[0]) * part
            poses[:, 1] = start[1] + (end[1] - start[1]) * part
        else:
            way, share = self._way
            for axis in range(2):
                poses[:, axis] = np.interp(part * share * (len(way) - 1), np.arange(len(way)), way[:, axis])
        poses[:, 2] = self._config.camera_height_m
        poses[:, 4] = t_us * 1e-6
        return poses

    def _set_renderer(self, scene: Scene) -> None:
        """Choose the renderer of a scene; reuse the last renderer if its settings are the same."""
        chosen, camera = plan_renders(self._planned, scene), self._config.camera
        same = self._renderer is not None
        same = same and (chosen.renderer, chosen.samples) == (self.plan.renderer, self.plan.samples)
        self.plan = chosen
        kind = ColumnCamera if chosen.by_looks else EventCamera
        if not isinstance(self._camera, kind):
            self._camera = kind(camera)
        if same:
            self._renderer.set_scene(scene)
            self._renderer.cull_m = chosen.cull_m
        else:
            self.close()
            self._renderer = make_renderer(chosen, scene, camera.width, camera.height, camera.fov_deg)
        if chosen.renderer == "raycast":
            self._renderer.expect_height(self._config.camera_height_m)


def check_sensed(bad: int, way: Way, columns: np.ndarray) -> None:
    """Raise ValueError if `sense_way` reported a problem; `columns` is the image that it rendered."""
    if bad == BAD_POSE:
        check_pose((way.end_x, way.end_y, way.height, 0.0), (way.start_us + way.moving_us) * 1e-6)
    if bad >= 0:
        x, y = divmod(bad, columns.shape[1])
        raise ValueError(f"luminance must be finite and >= 0; pixel x={x}, y={y} is {columns[x, y]!s}.")
