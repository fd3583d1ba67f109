"""trajectory.png and the view from above: a scale of round length, frame age and state."""

import cv2
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sightline.evaluation.demo.video import TopView, newest_status, status_text
from sightline.evaluation.plots import AgeLimits, StatusAt, _plot_age, _plot_things, plot_run, scale_length_m
from sightline.sim.scenario import Light, load_scenario
from sightline.sim.truth import Truth

LIMITS = AgeLimits(150, 400)


@pytest.fixture(scope="module")
def samples() -> list[Truth]:
    return [
        Truth(t_us=number * 100_000, x_m=number * 0.02, y_m=0.0, yaw_rad=0.0, linear_mps=0.2, angular_rad_s=0.0,
              target_x_m=1.0 + number * 0.02, target_y_m=0.2, target_z_m=0.1, bearing_rad=0.2, distance_m=1.0,
              visible=True, wall_contacts=0, target_contacts=0, target_contacts_by_robot=0)
        for number in range(50)
    ]


@pytest.mark.parametrize(("span_m", "length_m"), [(0.1, 0.1), (1.0, 0.2), (3.9, 0.5), (4.0, 1.0), (19.0, 2.0)])
def test_scale_is_round_and_at_most_a_quarter_of_the_view(span_m, length_m):
    assert scale_length_m(span_m) == length_m


def test_scale_of_the_film_has_the_length_that_it_names(samples):
    scenario = load_scenario("circle")
    view = TopView(samples, scenario, 480)
    line = (view.draw(0)[480 - 18] == (40, 40, 40)).all(axis=1).nonzero()[0]
    span_m = (1.0 + 49 * 0.02) + 2 * 0.4
    runs = np.split(line, (np.diff(line) > 1).nonzero()[0] + 1)
    bar = max(runs, key=len)  # the rest of the row is text
    assert (bar[-1] - bar[0]) / 480 * span_m == pytest.approx(scale_length_m(span_m), abs=0.03)


def area_like(path, color) -> int:
    """Pixels of a light tint of `color` (red, green, blue from 0 to 1) in the lower right of a picture."""
    image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)[400:, 600:].astype(int)
    tint = 255 * (0.25 * np.array(color) + 0.75)
    return int((abs(image - tint) < 3).all(axis=2).sum())


def test_title_may_have_any_letters(samples, tmp_path, recwarn):
    plot_run(tmp_path / "run.png", samples, load_scenario("static"), "\u5706\u5708 $x{$, seed 1")
    assert [str(one.message) for one in recwarn] == []


@pytest.mark.parametrize(("status_us", "states"), [(-1, []), (0, ["ACTIVE"]), (4_900_000, ["ACTIVE"]), (5_000_000, [])])
def test_legend_has_the_states_of_the_run_and_without_one_gives_no_warning(samples, recwarn, status_us, states):
    axes = Figure().subplots()
    _plot_age(axes, samples, [StatusAt(status_us, "ACTIVE", 30_000)], LIMITS)
    legend = axes.get_legend()
    assert (legend is not None) == bool(states)
    assert not legend or [text.get_text() for text in legend.get_texts()] == states
    assert [str(one.message) for one in recwarn] == []


@pytest.mark.slow
def test_plot_shows_the_state_behind_the_frame_age(samples, tmp_path):
    from matplotlib.colors import to_rgb

    scenario, path = load_scenario("circle"), tmp_path / "trajectory.png"
    states = [StatusAt(number * 100_000, "ACTIVE" if number < 25 else "STOPPED", 30_000) for number in range(50)]
    plot_run(path, samples, scenario, "run", statuses=states, limits=LIMITS)
    areas = [area_like(path, to_rgb(color)) for color in ("tab:green", "tab:red")]
    assert min(areas) > 5_000
    assert areas[0] == pytest.approx(areas[1], rel=0.35)
    plot_run(path, samples, scenario, "run")
    assert area_like(path, to_rgb("tab:green")) == 0


@pytest.mark.parametrize("bound_m", [0.25, None])
def test_demanded_clearance_is_the_bound_of_the_scenario(samples, monkeypatch, tmp_path, bound_m):
    drawn = []
    monkeypatch.setattr(FigureCanvasAgg, "draw", lambda _canvas: None)
    monkeypatch.setattr(FigureCanvasAgg, "print_png", lambda canvas, _path: drawn.extend(canvas.figure.axes))
    bounds = {} if bound_m is None else {"least_clearance_m": bound_m}
    plot_run(tmp_path / "x.png", samples, load_scenario("thymio").model_copy(update={"bounds": bounds}), "run")
    (axes,) = [axes for axes in drawn if axes.get_ylabel() == "clearance (m)"]
    demanded = [line.get_ydata()[0] for line in axes.lines if line.get_label() == "demanded"]
    assert demanded == ([] if bound_m is None else [bound_m])


@pytest.mark.parametrize(("faces_deg", "ends_m"), [
    (180.0, [(2.4, -1.05), (2.4, 0.15)]), (90.0, [(2.4, 0.15), (3.6, 0.15)]),
])  # fmt: skip
def test_stop_line_is_drawn_where_the_simulation_has_it(faces_deg, ends_m):
    light = Light(at_m=(3.0, -0.45), faces_deg=faces_deg)
    axes = Figure().add_subplot()
    _plot_things(axes, load_scenario("traffic-light").model_copy(update={"light": light, "things": ()}))
    (line,) = axes.lines
    assert sorted(zip(*line.get_data(), strict=True)) == [pytest.approx(end_m) for end_m in ends_m]


def test_film_shows_the_newest_state_and_its_frame_age():
    states = [StatusAt(100, "ACTIVE", 24_400), StatusAt(200, "DISARMED", None)]
    shown = [status_text(newest_status(states, t_us)) for t_us in (99, 100, 199, 200)]
    assert shown == ["", "ACTIVE  frame age 24 ms", "ACTIVE  frame age 24 ms", "DISARMED  no frame"]
