"""Command-line options in groups: an attribute is an option, one that begins with an underscore has a short flag."""

from argparse import ArgumentParser


class GroupParams:
    """The values of one group."""


class ParamGroup:
    def __init__(self, parser: ArgumentParser, name: str, fill_none=False):
        group = parser.add_argument_group(name)
        for key, value in vars(self).items():
            flags = [f"--{key[1:]}", f"-{key[1]}"] if key.startswith("_") else [f"--{key}"]
            default = None if fill_none else value
            if isinstance(value, bool):
                group.add_argument(*flags, default=default, action="store_true")
            else:
                group.add_argument(*flags, default=default, type=type(value))

    def extract(self, args):
        group = GroupParams()
        for key in vars(self):
            name = key.removeprefix("_")
            setattr(group, name, getattr(args, name))
        return group
