"""The picture of a fit: measured and fitted motion, residuals, and values with their priors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from estimate_support import known
from figure_checks import check_figure
from rerun.chunk import RrdReader
from scenes import preset

from plow_twin import plot_motion, simulate
from plow_twin.estimate.result import Motion
from plow_twin.estimate.summary import priors
from plow_twin.estimate.unknowns import QUANTITIES
from plow_twin.view.estimate import estimate_picture
from plow_twin.view.fitted import FittedPicture, FittedValue, write_fit_picture


@pytest.fixture(scope="module")
def picture() -> FittedPicture:
    truth, result = known()[0]
    labels = {quantity.name: quantity.label for quantity in QUANTITIES}
    prior = priors(truth.nominal, truth.load, truth.poses)
    return estimate_picture(result, prior, truth.poses, labels, "Estimate of a truth")


def test_the_residuals_of_the_fitted_motion_are_the_sensor_s_noise(picture: FittedPicture) -> None:
    assert picture.noise is not None
    residual = picture.motion.residual
    assert np.isfinite(residual).mean() > 0.5
    np.testing.assert_allclose(np.nanstd(residual, axis=0), picture.noise, rtol=0.1)
    # the motion is larger than the noise
    assert (np.nanstd(picture.motion.measured, axis=0) > 3.0 * np.array(picture.noise)).all()


def test_each_value_is_drawn_with_its_interval_relative_to_the_prior(picture: FittedPicture) -> None:
    values = {value.label: value for value in picture.values}
    horizontal = values["horizontal clearance [mm]"]
    assert horizontal.prior is not None and horizontal.note == "estimated"
    middle, low, high = horizontal.places()
    # the motion determines the value far better than the prior does
    assert -1.0 < low < middle < high < 1.0 and high - low < 0.1
    assert FittedValue("", (2.0, 1.0, 3.0), (2.0, 1.0, 3.0)).places() == pytest.approx([0.0, -1.0, 1.0])
    assert FittedValue("", (-1.5, -2.0, -1.0), None, ".1f").text == "−1.5 (−2.0 to −1.0)"


def test_the_picture_has_words_and_units_and_hides_no_data(picture: FittedPicture) -> None:
    figure = picture.figure()
    check_figure(figure)
    labels = {axis.get_ylabel() for axis in figure.axes}
    assert {"x [mm]", "y [mm]", "θ [mrad]", "residual\n[mm]", "residual\n[mrad]"} <= labels
    assert "model ok, sensor ok" in figure.get_suptitle()


def test_without_a_fit_the_panel_of_residuals_has_a_note(picture: FittedPicture) -> None:
    nothing = np.full_like(picture.motion.measured, np.nan)
    figure = replace(picture, motion=Motion(picture.motion.t, picture.motion.measured, nothing)).figure()
    below = [axis for axis in figure.axes if axis.get_ylabel().startswith("residual")]
    assert [[text.get_text() for text in axis.texts] for axis in below] == [["no fit"]] * 3
    assert not any(axis.lines or axis.get_legend() or axis.get_yticks().size for axis in below)


def test_a_component_that_was_not_measured_has_a_fitted_motion_without_residuals(picture: FittedPicture) -> None:
    measured = picture.motion.measured.copy()
    measured[:, 2] = np.nan
    figure = replace(picture, motion=Motion(picture.motion.t, measured, picture.motion.model)).figure()
    below = [axis for axis in figure.axes if axis.get_ylabel().startswith("residual")]
    assert [[text.get_text() for text in axis.texts] for axis in below] == [[], [], ["not measured"]]
    angle = next(axis for axis in figure.axes if axis.get_ylabel() == "θ [mrad]")
    assert "fitted" in angle.get_legend_handles_labels()[1]


def test_the_rerun_file_of_a_fit_has_the_same_numbers(picture: FittedPicture, tmp_path: Path) -> None:
    write_fit_picture(picture, tmp_path / "fit.rrd")
    rows, table = {}, ""
    for chunk in RrdReader(str(tmp_path / "fit.rrd")).stream():
        batch = chunk.to_record_batch()
        if "Scalars:scalars" in batch.schema.names:
            rows[chunk.entity_path] = np.array(batch["Scalars:scalars"].to_pylist()).ravel()
        elif chunk.entity_path == "/values":
            table = batch["TextDocument:text"].to_pylist()[0][0]
    residual = picture.motion.residual[:, 2]
    np.testing.assert_allclose(rows["/residual/theta"], 1e3 * residual[np.isfinite(residual)])
    assert len(rows["/pose/x/fitted"]) > 100
    assert picture.values[0].text in table and "prior" in table


def test_a_notebook_shows_an_estimate_with_intervals_and_states() -> None:
    result = known()[0][1]
    shown = result._repr_html_()
    assert f"<td>{1e3 * result.horizontal.p05:.3f}</td>" in shown and "<td>estimated</td>" in shown
    assert "model ok, sensor ok" in shown


def test_a_notebook_shows_a_motion_and_scripts_write_it(tmp_path: Path) -> None:
    result = simulate(preset("paper"), 1.0)
    figure = plot_motion(result)
    check_figure(figure)
    position, angle, force = figure.axes
    np.testing.assert_array_equal(position.lines[1].get_ydata(), 1e3 * result.q[:, 1])
    np.testing.assert_array_equal(angle.lines[0].get_ydata(), 1e3 * result.q[:, 2])
    largest = max(float(np.max(line.get_ydata())) for line in force.lines)
    assert largest == result.force.max() / 1e3 and force.get_ylabel() == "contact force [kN]"
    assert figure._repr_png_()[:4] == b"\x89PNG"  # a notebook can show the figure without pyplot
    figure.savefig(tmp_path / "motion.png")
    assert plot_motion(result, "of mine").get_suptitle() == "of mine"
