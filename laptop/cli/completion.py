"""`swarm completion`: a script with which bash and zsh complete commands: `eval "$(swarm completion)"`."""

import argparse

from laptop.cli.commands import SECTIONS
from swarm.onboard.command_line import CommandGroup, commands_of

HELP = "print a script with which bash or zsh complete commands"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Take no argument: bash and zsh read the same script."""
    del parser


def run(args: argparse.Namespace) -> int:
    """Print the script: it completes names of commands, then those of a group, then files."""
    del args
    commands = commands_of(SECTIONS)
    groups = "".join(
        f'        {name}) words="{" ".join(each.commands)}" ;;\n'
        for name, each in commands.items()
        if isinstance(each, CommandGroup)
    )
    print(
        f"""[ -n "$ZSH_VERSION" ] && autoload -U +X compinit bashcompinit && compinit && bashcompinit
_swarm() {{
    local words=""
    if [ "$COMP_CWORD" -eq 1 ]; then
        words="{" ".join(commands)}"
    elif [ "$COMP_CWORD" -eq 2 ]; then
        case "${{COMP_WORDS[1]}}" in
{groups}        esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _swarm swarm"""
    )
    return 0
