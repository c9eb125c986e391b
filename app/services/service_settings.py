"""What an operator can set, by argument or environment variable (prefix OSF_)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field, SecretStr, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from osfcore.world.simulators import Simulator, default_simulator

from ..storage.paths import default_data_dir

Names = Annotated[tuple[str, ...], NoDecode]


class Settings(BaseSettings):
    """Settings of the service. Lists in the environment are comma-separated."""

    model_config = SettingsConfigDict(env_prefix="OSF_", frozen=True, extra="forbid")

    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=0, le=65535, description="0 takes any free port.")
    data_dir: Path = Field(default_factory=default_data_dir, description="Objects, database and collections.")
    allowed_hosts: Names = Field(
        default=(), description="Host names under which the page may be opened besides localhost and plain addresses."
    )
    allowed_origins: Names = Field(
        default=(), description="Origins, such as https://lab.example, that may use the service besides its own."
    )
    token: SecretStr | None = Field(default=None, min_length=8, description="That every request must bring, if set.")
    robot: str | None = Field(
        default=None, description="Address of a robot that may be driven, as 'osf robot' takes it."
    )
    robot_box: tuple[float, float, float, float] | None = Field(
        default=None, description="x0, y0, x1, y1 [m] that its pusher's centre stays in, as JSON."
    )
    robot_top_speed_m_s: float = Field(default=0.1, description="Of its pusher.")
    simulator: Simulator = Field(
        default_factory=default_simulator, description="What moves the objects; PyBullet where it is installed."
    )
    demo_scene: bool = Field(default=True, description="Whether a scene is made when there is none.")
    max_body_bytes: int = Field(default=4 << 20, ge=1024)  # a thousand sequences of thirty actions in full precision
    max_upload_bytes: int = Field(default=1 << 30, ge=1024, description="Of a zipped image set or observation.")
    max_photo_bytes: int = Field(default=20 << 20, ge=1024, description="Of a goal image or a photo of a table.")
    max_goals: int = Field(default=100, ge=1, description="Goal images kept at once.")
    max_photos: int = Field(default=50, ge=1, description="Photos of tables kept at once.")
    max_image_sets: int = Field(default=20, ge=1, description="Uploaded image sets kept at once.")
    max_scenes: int = Field(default=32, ge=1, description="Scenes kept at once.")
    max_live_worlds: int = Field(default=4, ge=1, description="Scenes whose simulation stays in memory.")
    max_queued_jobs: int = Field(default=20, ge=1, description="Jobs waiting at once.")
    max_data_bytes: int = Field(
        default=50 << 30, ge=0, description="That the data directory may hold before new work is refused; 0 for any."
    )
    min_free_bytes: int = Field(
        default=200_000_000, ge=0, description="That must stay free on its disk, or new work is refused."
    )
    max_stored_events: int = Field(default=1000, ge=10, description="Job events kept for reconnecting pages.")
    image_cache_bytes: int = Field(default=32 << 20, ge=0)
    standby: bool = Field(
        default=True, description="Whether a process waits for the next episode, with its code loaded."
    )
    cancel_grace_s: float = Field(default=0.7, ge=0, description="How long a cancelled job may take to stop by itself.")
    stage_timeout_s: float = Field(default=60.0, gt=0, description="How long one command to the simulation may take.")

    @field_validator("allowed_hosts", "allowed_origins", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        if isinstance(value, str):
            return tuple(part.strip() for part in value.split(",") if part.strip())
        return value
