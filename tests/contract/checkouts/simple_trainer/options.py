"""Read options of a dataclass from the command line, in the way of tyro's overridable configurations."""

import dataclasses
import sys


def overridable(configs):
    """Return the configuration that the first argument names, with the values of the options after it."""
    name, *words = sys.argv[1:]
    config = configs[name]
    while words:
        option, words = words[0].removeprefix("--"), words[1:]
        values = []
        while words and not words[0].startswith("--"):
            values.append(words.pop(0))
        owner, _, attribute = option.rpartition(".")
        of = getattr(config, owner) if owner else config
        known = {field.name for field in dataclasses.fields(of)}
        if attribute not in known:
            sys.exit(f"unknown option --{option}")
        setattr(of, attribute, _parsed(getattr(of, attribute), values))
    return config


def _parsed(default, values):
    if isinstance(default, bool) and not values:
        return True
    if isinstance(default, list):
        return [int(value) for value in values]
    return values[0] if isinstance(default, str) else type(default)(values[0]) if default is not None else values[0]
