"""What the bridge's commands share: help, and one clear message for what whoever types can mend."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import NoReturn, TypeVar

from bridges.messages import BridgeError
from bridges.settings import parse
from emrld_jax.runs.usage import usage

HELP = ("-h", "--help", "help")

Config = TypeVar("Config")


def configured(
    command: str,
    purpose: str,
    examples: Sequence[str],
    defaults: Config,
    meant: Callable[[Sequence[str]], Sequence[str]] = list,
) -> Config | None:
    """The settings that the command line gives; None after it asked for help, which is printed.

    Args:
        command: its name after `python -m`.
        purpose: in a line.
        examples: arguments.
        defaults: all settings.
        meant: arguments of another form as settings.

    Raises:
        SettingError: names what is wrong and what is allowed.
    """
    arguments = sys.argv[1:]
    if any(argument in HELP for argument in arguments):
        print(usage(command, purpose, examples, defaults, {}))
        return None
    return parse(meant(arguments), defaults)


def run_command(main: Callable[[], int]) -> NoReturn:
    """Runs a command and exits."""
    try:
        code = main()
    except (BridgeError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        code = 130
    sys.exit(code)
