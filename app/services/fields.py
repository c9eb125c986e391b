"""The fields of this machine as the page lists them: those shipped with the program and those trained here."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Literal

from osfcore.errors import OsfError
from osfcore.fields.field_library import FIELD_FILE, METRICS_FILE, FieldInfo, FieldLibrary
from osfcore.paper.method import Method, own_field_path, paper_field_names

from ..storage.field_files import install, uninstall, uninstall_published


class ShippedField(OsfError):
    """A field that belongs to the program."""

    def __init__(self, name: str) -> None:
        super().__init__(f"The field of {name} is shipped with the program and cannot be deleted.")


class NoTrainedField(OsfError):
    """A training that has left no field to use."""

    def __init__(self, name: str) -> None:
        super().__init__(f"That training has left no field of {name}; train it again.")


class MissingFields(OsfError):
    """Objects that can be neither rendered nor recognised."""

    def __init__(self, names: Collection[str]) -> None:
        super().__init__(f"There is no field yet for {', '.join(names)}; train one in Your objects.")
        self.names = tuple(names)


class NoPublishedField(OsfError):
    """Objects without a field as published."""

    def __init__(self, names: Collection[str]) -> None:
        super().__init__(
            f"There is no field as published for {', '.join(names)}; choose our method, or train one in Your objects."
        )


class FieldCatalogue(FieldLibrary):
    """The fields of this machine, those as published, and how they come and go.

    Args:
        data_dir: of the service.
        meshes: have the names of the objects that scenes can hold.
    """

    def __init__(self, data_dir: Path, meshes: Callable[[], Collection[str]]) -> None:
        super().__init__(data_dir)
        self._data_dir, self._meshes = data_dir, meshes

    def all(self) -> tuple[FieldInfo, ...]:
        """All fields that can be described, sorted by name."""
        infos = []
        for name in self.names():
            with contextlib.suppress(OsfError, OSError):  # one that is being deleted must not hide the others
                infos.append(self.info(name))
        return tuple(infos)

    def published(self) -> tuple[str, ...]:
        """Objects with a field as published."""
        return paper_field_names(self._data_dir)

    def origin_of_published(self, name: str) -> Literal["shipped", "trained"] | None:
        """Where an object's field as published comes from; None if there is none."""
        if own_field_path(name, self._data_dir).is_file():
            return "trained"
        return "shipped" if name in self.published() else None

    def require(self, names: Collection[str], method: Method) -> None:
        """Refuse objects that a method cannot recognise.

        Raises:
            MissingFields: if one has no field at all.
            NoPublishedField: if one has none as published, and that method wants it.
        """
        if missing := sorted(set(names) - set(self.names())):
            raise MissingFields(missing)
        if method == "paper" and (missing := sorted(set(names) - set(self.published()))):
            raise NoPublishedField(missing)

    def get(self, name: str) -> FieldInfo:
        """One field.

        Raises:
            UnknownName: if there is none.
        """
        return self.info(name)

    def has_mesh(self, name: str) -> bool:
        """Whether scenes can simulate the object."""
        return name in self._meshes()

    def use(self, name: str, made: Path) -> None:
        """Put a field that training has left in a folder, as NAME.safetensors and NAME.json, in the place of another.

        Raises:
            NoTrainedField: if it is not there, or not there any more.
            CannotWrite: if the disk refuses; then nothing is changed.
        """
        with tempfile.TemporaryDirectory() as folder:
            try:
                for file in (FIELD_FILE, METRICS_FILE):
                    shutil.copyfile(made / f"{name}{Path(file).suffix}", Path(folder) / file)
            except OSError as error:
                raise NoTrainedField(name) from error
            install(Path(folder), self.folder(name))

    def remove(self, name: str) -> None:
        """Delete a field that was trained here; a shipped one of the same name then counts again.

        Raises:
            UnknownName: if there is none.
            ShippedField: if it was not trained here.
            CannotWrite: if that is not allowed.
        """
        if self.info(name).source != "trained":
            raise ShippedField(name)
        uninstall(self.folder(name))

    def remove_published(self, name: str) -> None:
        """Delete a field as published that was trained here; a shipped one of the same name then counts again.

        Raises:
            ShippedField: if none was trained here.
            CannotWrite: if that is not allowed.
        """
        if self.origin_of_published(name) != "trained":
            raise ShippedField(name)
        uninstall_published(own_field_path(name, self._data_dir))
