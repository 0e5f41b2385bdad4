import numpy as np

from jaxfilters.models.articulated.layout import Layout, five_fingers
from jaxfilters.trackers.articulated.state import ArticulatedTrack
from jaxfilters.trackers.articulated.table import TimedArticulatedTrack, articulated_table

DIAGNOSTICS = ("weight", "num_hypotheses", "is_new_view", "nis_per_row", "least_distance", "log_evidence")


def test_columns_have_the_names_of_the_state_and_units():
    columns = articulated_table(Layout(1)).columns
    assert columns == (
        *("wrist_x_px", "wrist_y_px", "q_w", "q_x", "q_y", "q_z"),
        *(f"theta_1{joint}_rad" for joint in range(4)),
        *("wrist_x_rate_px_per_frame", "wrist_y_rate_px_per_frame"),
        *("q_w_rate_per_frame", "q_x_rate_per_frame", "q_y_rate_per_frame", "q_z_rate_per_frame"),
        *(f"theta_1{joint}_rate_rad_per_frame" for joint in range(4)),
        *("r_11_px", "r_12_px", "r_13_px", "r_w_px", "r_h_px", "r_d_px"),
        *("wrist_x_std_px", "wrist_y_std_px", "q_w_std", "q_x_std", "q_y_std", "q_z_std"),
        *(f"theta_1{joint}_std_rad" for joint in range(4)),
        *("wrist_x_rate_std_px_per_frame", "wrist_y_rate_std_px_per_frame"),
        *("q_w_rate_std_per_frame", "q_x_rate_std_per_frame", "q_y_rate_std_per_frame", "q_z_rate_std_per_frame"),
        *(f"theta_1{joint}_rate_std_rad_per_frame" for joint in range(4)),
        *("r_11_std_px", "r_12_std_px", "r_13_std_px", "r_w_std_px", "r_h_std_px", "r_d_std_px"),
        *DIAGNOSTICS,
        *("r_11_observed", "r_12_observed", "r_13_observed"),
    )
    five = articulated_table(five_fingers()).columns
    assert len(five) == len(set(five)) == 2 * five_fingers().size + len(DIAGNOSTICS) + 15


def test_lengths_of_a_hand_in_space_are_in_metres():
    columns = articulated_table(five_fingers(3)).columns
    assert {"wrist_z_m", "r_11_m", "r_w_std_m", "wrist_z_rate_m_per_frame", "theta_13_rad"} <= set(columns)
    assert not any(column.endswith("_px") for column in columns)


def test_a_row_is_the_track_at_one_frame(perfect_track):
    table = articulated_table(Layout(2))
    parts = [part.values(perfect_track).reshape(len(perfect_track.times_s), -1) for part in table.parts]
    numbers = np.concatenate(parts, axis=1)
    cells = dict(zip(table.columns, numbers.T, strict=True))
    names = Layout(2).names
    np.testing.assert_array_equal(cells["theta_13_rad"], perfect_track.mean[:, names.index("theta_13")])
    np.testing.assert_array_equal(cells["r_h_px"], perfect_track.mean[:, names.index("r_h")])
    np.testing.assert_array_equal(cells["q_y_rate_std_per_frame"], perfect_track.std[:, names.index("q_y_rate")])
    for name in DIAGNOSTICS:
        np.testing.assert_array_equal(cells[name], getattr(perfect_track, name))


def test_the_fields_are_those_of_the_tracker_between_time_and_status():
    assert TimedArticulatedTrack._fields == ("times_s", *ArticulatedTrack._fields)
