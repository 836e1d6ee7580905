"""What is public stays: names, parameters, options of the command and formats of files."""

from tests.support import public_api


def test_public_names_are_those_of_the_record():
    """A name that goes needs a new major version, see docs/guide/versions.md; a new one is added to the record."""
    recorded = public_api.RECORD.read_text().splitlines()
    assert list(public_api.lines()) == recorded, "python -m tests.support.public_api writes the record again"
