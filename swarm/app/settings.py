"""An app's parameters given on a command line: `gain=0.5`, or `r2.value=3` for one robot, on top of swarm.toml."""

from collections.abc import Iterable
from dataclasses import replace

from swarm.app.parameters import value_of
from swarm.config import Config
from swarm.config.types import AppConfig
from swarm.errors import AppError, ConfigError
from swarm.frozen import frozen
from swarm.messages.codec import Value


@frozen
class Setting:
    """A parameter of an app; `robot` is None where it holds for all."""

    robot: str | None
    name: str
    value: Value

    @property
    def text(self) -> str:
        """Return the setting as text that `parse` reads."""
        value = self.value
        if isinstance(value, bool):
            shown = str(value).lower()
        elif isinstance(value, tuple):
            shown = f"[{','.join(map(repr, value))}]"
        else:
            shown = str(value)
        return f"{f'{self.robot}.' if self.robot else ''}{self.name}={shown}"


def parse(text: str) -> Setting:
    """Parse a setting such as `r2.value=3`; raises `AppError`."""
    name, equals, value = text.partition("=")
    robot, dot, parameter = name.rpartition(".")
    if not equals or not parameter.isidentifier() or (dot and not robot):
        raise AppError(f"{text!r} is not a setting such as value=0.5 or r2.value=3")
    return Setting(robot if dot else None, parameter, value_of(value))


def common_and_single(settings: Iterable[Setting]) -> tuple[dict[str, Value], dict[str, dict[str, Value]]]:
    """Return the values for all robots by name, and those for single robots by robot and name."""
    common: dict[str, Value] = {}
    single: dict[str, dict[str, Value]] = {}
    for setting in settings:
        values = common if setting.robot is None else single.setdefault(setting.robot, {})
        values[setting.name] = setting.value
    return common, single


def on_top(app: AppConfig, settings: Iterable[Setting], robots: Iterable[str]) -> AppConfig:
    """Return the app's parameters with these settings: those of one robot above those of all, else the later ones
    above. One for all robots is above the file's for one.

    Raises `ConfigError` for a robot that there is not.
    """
    common, single = common_and_single(settings)
    names = tuple(robots)
    for robot, values in single.items():
        if robot not in names:
            raise ConfigError(f"--set {robot}.{next(iter(values))}: the robots are {', '.join(names)}")
    kept = {
        robot: {name: value for name, value in values.items() if name not in common}
        for robot, values in app.robots.items()
    }
    both = {robot: kept.get(robot, {}) | single.get(robot, {}) for robot in (*kept, *single)}
    return AppConfig({**app.parameters, **common}, both)


def with_settings(config: Config, app: str, settings: Iterable[Setting]) -> Config:
    """Return the config with these settings of an app; raises `ConfigError` for a robot that there is not."""
    return replace(config, apps={**config.apps, app: on_top(config.app(app), settings, config.names)})
