"""One look for every method in every figure."""

from studies import methods, speed, style

COMPARED = {method.name for method in (*methods.CONSTANT_ENERGY.values(), *methods.PAPER)}
COMPARED |= {method.method.name.removesuffix(" in a bath") for method in speed.contestants(False)}


def test_every_method_that_can_be_compared_has_a_look():
    assert [name for name in sorted(COMPARED) if style.of_method(name)["color"] == style.UNKNOWN[0]] == []
