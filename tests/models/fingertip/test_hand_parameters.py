"""Parameters that detection cannot use are refused by name."""

import pytest

from jaxfilters.models.fingertip.hand_parameters import HandParameters


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("tip_radius", 1.0),
        ("tip_radius", float("nan")),
        ("half_size", 6),
        ("half_size", 14),
        ("min_correlation", 0.0),
        ("min_correlation", 1.0),
        ("phi_thumb", 0.1),
        ("handedness", 0),
    ],
)
def test_values_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        HandParameters(**{name: value})


def test_the_defaults_are_those_of_the_specification():
    usual = HandParameters()
    assert (usual.tip_radius, usual.half_size, usual.handedness) == (6.5, 9, 1)
    assert usual.phi_index < usual.phi_thumb
