"""Options of commands, assembled once for all tests."""

from copy import copy

import pytest
from cyclopts import App
from cyclopts.argument import ArgumentCollection


def assembled_once():
    """Let Cyclopts assemble the options of each command once, and not for each command line, while this is iterated.

    That takes six sevenths of the time in which a command line is read.
    """
    assemble, kept = App.assemble_argument_collection, {}

    def assembled(app, **options):
        if options:
            return assemble(app, **options)
        if app.default_command not in kept:
            kept[app.default_command] = assemble(app)
        return _unused(kept[app.default_command])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(App, "assemble_argument_collection", assembled)
        yield


def _unused(arguments):
    """Copies of the arguments of a command, without tokens."""
    copies = {id(argument): copy(argument) for argument in arguments}
    for argument in copies.values():
        argument.tokens = []
        argument.children = ArgumentCollection(copies[id(child)] for child in argument.children)
    return ArgumentCollection(copies.values())
