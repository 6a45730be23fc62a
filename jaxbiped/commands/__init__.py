"""The commands of `jaxbiped`, one module each: a record of its arguments, and `run`, which prints and returns."""

from jaxbiped.commands import demo, export, walk
from jaxbiped.commands.common import InputError

__all__ = ["InputError", "demo", "export", "walk"]
