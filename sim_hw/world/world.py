"""The emulated world: rig, plan, flight, terrain, true camera, temperatures, scene.

Everything follows from `WorldSettings`, so that each process builds the same world from the same
few numbers. The caller supplies the time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from processing.rig import Cone, Rig, VirtualImage, load_rig
from sim_hw.world import scene, terrain, true_camera
from sim_hw.world.cloud import Cloud, cloud_over
from sim_hw.world.flight import FlightPlan, SimulatedFlight
from sim_hw.world.ground_types import GROUNDS, GroundType
from sim_hw.world.traffic import Car, cars_of

FORWARD_OVERLAP = 0.6
SIDE_OVERLAP = 0.3
TDI_EXPOSURE_S = 0.005
"""Exposures are planned near this; exactly a whole number of TDI shifts long."""
FILTERED_SMEAR_PX = 0.5
"""Heads behind a colour filter array have no TDI; they expose for at most so much motion."""
CABIN_C = 20.0
SIDE_MARGIN = 0.11
"""Share of the image width that the scene is wider on either side: tremor, crab and wander."""
END_MARGIN = 0.16
"""Likewise at the ends of a line, in image heights."""
SCENE_MAX_PX = 250_000_000
WHITE_LEVEL = 0.8
"""Where white comes in the planned exposure, as a share of the converter's range."""


@dataclass(frozen=True)
class WorldSettings:
    """All that makes a world. `displaced_px` moves sensors by (right, up) pixels in their layer.

    `scene_margin_m` makes the scene larger on all sides, for lines after the first and for turns.
    `height_m` above mean ground and `ground_speed_mps` default to what suits the rig. `ground` is a
    name of `grounds.GROUNDS`; `cloud_over` names a sensor that a cloud hides the ground from, in
    the first image of the line.
    """

    rig_file: str
    seed: int
    epoch_gps_ns: int
    dc_k: float = 0.0
    displaced_px: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    height_m: float | None = None
    ground_speed_mps: float | None = None
    heading_deg: float = 0.0
    exposures: int = 13
    scene_margin_m: float = 0.0
    relative_relief: float = 0.003
    scene_file: str | None = None
    ground: str = "landscape"
    cloud_over: str | None = None


@dataclass(frozen=True)
class SurveyPlan:
    """What a crew would enter: the way between exposures, and how long each head exposes."""

    distance_m: float
    height_above_ground_m: float
    ground_height_m: float
    ground_speed_mps: float
    gsd_m: float
    exposure_time_us: Mapping[str, float]
    tdi_shifts: Mapping[str, int]


class World:
    """The world of one emulated rig.

    Raises:
        processing.rig.RigError: the rig file cannot be used.
        ValueError: a setting does not fit the rig.
    """

    def __init__(self, settings: WorldSettings) -> None:
        self.settings = settings
        self.rig: Rig = load_rig(Path(settings.rig_file))
        for name in settings.displaced_px:
            if name not in {s.name for s in self.rig.sensors}:
                known = ", ".join(s.name for s in self.rig.sensors)
                raise ValueError(f"displaced sensor {name!r} is not in the rig; it has {known}")
        if settings.ground not in GROUNDS:
            raise ValueError(
                f"ground {settings.ground!r} is not known; give one of: {', '.join(GROUNDS)}"
            )
        self.plan = survey_plan(self.rig, settings)
        self.flight = SimulatedFlight(
            plan=_flight_plan(self.image, self.plan, settings),
            seed=settings.seed,
            epoch_gps_ns=settings.epoch_gps_ns,
        )
        self.terrain = terrain.mild_relief(
            settings.seed,
            flying_height_m=self.plan.height_above_ground_m,
            relative_relief=settings.relative_relief,
        )
        self.camera = true_camera.true_camera(
            self.rig, settings.seed, displaced_px=settings.displaced_px
        )
        self.temperatures = true_camera.true_temperatures(
            self.rig, settings.seed, dc_k=settings.dc_k
        )

    @property
    def image(self) -> VirtualImage:
        """The image the flight is planned for: the rig's, else that of its master head."""
        return planned_image(self.rig)

    def temperature_c(self, probe: str, gps_ns: int) -> float:
        """The true temperature of a probe; of a sensor without one (""), that of the cabin."""
        if not probe:
            return CABIN_C
        return self.temperatures.at(probe, (gps_ns - self.settings.epoch_gps_ns) * 1e-9)

    def electrons_per_radiance_s(self, cone: Cone) -> float:
        """Sensitivity of a cone's sensors: white is well exposed at the planned time."""
        sensor = cone.sensors[0]
        electrons = WHITE_LEVEL * sensor.full_scale_dn * sensor.electrons_per_dn
        return electrons / (self.plan.exposure_time_us[cone.name] * 1e-6)

    def field_radius_mm(self, cone: Cone) -> float:
        """From the axis of a lens to the corner of its part of the virtual image, or of its own."""
        if self.rig.virtual_image is None:
            sensor = cone.sensors[0]
            return math.hypot(sensor.width_px, sensor.height_px) / 2 * sensor.pitch_um * 1e-3
        image = self.image
        diagonal = math.hypot(image.width_px, image.height_px) / 2 * image.pitch_um * 1e-3
        return diagonal * cone.lens.f_mm / image.f_mm

    @cached_property
    def scene_settings(self) -> scene.SceneSettings:
        """The scene a first line of `exposures` exposures needs."""
        image, plan, settings = self.image, self.plan, self.settings
        margin = 2.0 * self.scene_margin_px
        width = round(image.width_px * (1 + 2 * SIDE_MARGIN) + margin)
        along = (settings.exposures - 1) * plan.distance_m / plan.gsd_m
        height = round(along + image.height_px * (1 + 2 * END_MARGIN) + margin)
        height = min(height, SCENE_MAX_PX // width)
        return scene.SceneSettings(
            seed=settings.seed,
            width_px=width,
            height_px=height,
            sample_m=plan.gsd_m,
            colour_ratio=image.colour_ratio,
            file=settings.scene_file,
            ground=settings.ground,
        )

    @property
    def scene_margin_px(self) -> float:
        """`scene_margin_m` in samples of the scene."""
        return self.settings.scene_margin_m / self.plan.gsd_m

    @property
    def ground(self) -> GroundType:
        """What kind of ground is flown over."""
        return GROUNDS[self.settings.ground]

    @cached_property
    def cars(self) -> tuple[Car, ...]:
        """What moves on the ground."""
        return cars_of(self.scene_settings) if self.ground.moves else ()

    @cached_property
    def cloud(self) -> Cloud | None:
        """The cloud over one sensor's part of the first image, where there is one."""
        if self.settings.cloud_over is None:
            return None
        cone = self.rig.cone_of(self.settings.cloud_over)
        sensor = self.rig.sensor(self.settings.cloud_over)
        ground_m_per_mm = self.plan.height_above_ground_m / cone.lens.f_mm
        size_mm = (sensor.width_px * sensor.pitch_mm, sensor.height_px * sensor.pitch_mm)
        return cloud_over(
            self.settings.seed,
            place_m=(sensor.x_mm * ground_m_per_mm, sensor.y_mm * ground_m_per_mm),
            size_m=(size_mm[0] * ground_m_per_mm, size_mm[1] * ground_m_per_mm),
            flying_height_m=self.plan.height_above_ground_m,
            gsd_m=self.plan.gsd_m,
        )

    @property
    def scene_covers_the_line(self) -> bool:
        """False where the scene had to end before the line does; it is then seen mirrored."""
        image, plan = self.image, self.plan
        along = (self.settings.exposures - 1) * plan.distance_m / plan.gsd_m
        return self.scene_settings.height_px >= along + image.height_px


def planned_image(rig: Rig) -> VirtualImage:
    """The virtual image, or what the master head of a rig without one sees."""
    if rig.virtual_image is not None:
        return rig.virtual_image
    cone = rig.cone(rig.master_cone)
    sensor = cone.sensors[0]
    return VirtualImage(sensor.width_px, sensor.height_px, sensor.pitch_um, cone.lens.f_mm, 1)


def survey_plan(rig: Rig, settings: WorldSettings) -> SurveyPlan:
    """Plan 60 % forward overlap and exposures of whole TDI shifts (none for Bayer heads)."""
    image = planned_image(rig)
    is_small = image.width_px < 5000
    height = settings.height_m or (3000.0 if is_small else 1000.0)
    speed = settings.ground_speed_mps or (55.0 if is_small else 70.0)
    gsd = image.pitch_um * 1e-3 * height / image.f_mm
    times, shifts = {}, {}
    for cone in rig.cones:
        sensor = cone.sensors[0]
        cone_gsd = sensor.pitch_um * 1e-3 * height / cone.lens.f_mm
        if sensor.colour_filter_array != "none":
            # Shifted charge would gather light of other filters: exposed shortly instead.
            shifts[cone.name] = 0
            seconds = min(TDI_EXPOSURE_S, FILTERED_SMEAR_PX * cone_gsd / speed)
        else:
            shifts[cone.name] = max(1, round(TDI_EXPOSURE_S * speed / cone_gsd))
            seconds = shifts[cone.name] * cone_gsd / speed
        times[cone.name] = round(seconds * 1e6, 1)
    return SurveyPlan(
        distance_m=round((1 - FORWARD_OVERLAP) * image.height_px * gsd, 3),
        height_above_ground_m=height,
        ground_height_m=FlightPlan.ground_height_m,
        ground_speed_mps=speed,
        gsd_m=gsd,
        exposure_time_us=times,
        tdi_shifts=shifts,
    )


def _flight_plan(image: VirtualImage, plan: SurveyPlan, settings: WorldSettings) -> FlightPlan:
    return FlightPlan(
        height_m=plan.height_above_ground_m,
        ground_speed_mps=plan.ground_speed_mps,
        line_length_m=settings.exposures * plan.distance_m,
        line_spacing_m=(1 - SIDE_OVERLAP) * image.width_px * plan.gsd_m,
        heading_deg=settings.heading_deg,
    )


def describe(world: World) -> Sequence[str]:
    """Sentences about a world for the person who starts the emulator."""
    plan = world.plan
    sentences = [
        f"{world.rig.name}: {plan.height_above_ground_m:.0f} m above ground, "
        f"{plan.ground_speed_mps:.0f} m/s, GSD {plan.gsd_m * 100:.1f} cm, "
        f"an exposure every {plan.distance_m:.1f} m "
        f"({plan.distance_m / plan.ground_speed_mps:.2f} s)",
        f"dC {world.settings.dc_k:+.1f} K",
    ]
    sentences += [
        f"{name} is displaced by {x:+.2f} px right, {y:+.2f} px up"
        for name, (x, y) in world.settings.displaced_px.items()
    ]
    if not world.scene_covers_the_line:
        sentences.append("the scene is shorter than the line: its end is seen mirrored")
    return sentences
