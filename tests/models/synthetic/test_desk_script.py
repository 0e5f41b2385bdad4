import numpy as np

from jaxfilters.models.synthetic.desk_script import SHAPES, script


def test_a_script_draws_every_symbol_with_the_fingers_that_it_says():
    fingers, poses, symbols = script(3)
    assert len(fingers) == len(poses)
    assert [symbol.label.rsplit(" ", 1)[0] for symbol in symbols] == list(SHAPES)
    for symbol in symbols:
        during = fingers[symbol.first : symbol.last + 1]
        assert np.all(during == during[0])
        assert during[0].sum() == int(symbol.label[-1])
        assert not during[0, 0]  # the thumb is folded
        still = poses[symbol.first - 5 : symbol.first, :2]
        np.testing.assert_allclose(still, np.broadcast_to(poses[symbol.first, :2], still.shape))
        assert np.ptp(poses[symbol.first : symbol.last + 1, :2], axis=0).max() > 20


def test_the_hand_moves_without_jumps_and_stays_on_the_desk():
    _, poses, _ = script(1)
    assert np.abs(np.diff(poses[:, :2], axis=0)).max() < 15
    assert np.all((poses[:, :2] > (60, 60)) & (poses[:, :2] < (260, 220)))
