"""Panels: labels are inside the drawing, legends do not cover the data."""

from __future__ import annotations

import numpy as np
import pytest

from thermocald.figures import Curve, Panel, draw_panel


@pytest.mark.parametrize("lowest", [-1234.0, -0.0123, -9.9e-5, 3.0405])
def test_the_y_label_is_inside_the_drawing_and_clear_of_the_numbers(lowest):
    """Half of `Δx₀ in µm` was cut off if ticks had more digits than expected."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    x = np.linspace(0, 25, 150)
    curves = tuple(Curve(f"M{i}", x, lowest * np.sin(x / (7 + i))) for i in (1, 2))
    name = "Fühler 12 an der Brücke (Nordseite)"
    for panel in (Panel(name, "time in min", "Δx₀ in µm", curves[:1]),
                  Panel("x", "time in min", "ΔA3 in 10⁻⁵ mm⁻⁶", curves)):  # fmt: skip
        drawing = draw_panel(panel)
        canvas = FigureCanvasAgg(drawing)
        canvas.draw()
        (axis,) = drawing.axes
        label = axis.yaxis.label.get_window_extent(canvas.get_renderer())
        low, high = axis.get_ylim()
        ticks = zip(axis.get_yticks(), axis.get_yticklabels(), strict=True)
        numbers = [t.get_window_extent() for y, t in ticks if low <= y <= high]
        assert label.x0 >= 1.0
        assert axis._left_title.get_window_extent().x1 < drawing.bbox.x1
        assert label.x1 <= min(n.x0 for n in numbers) + 1.0
        legend = axis.get_legend()
        if legend is not None:
            assert legend.get_window_extent().y0 >= axis.get_window_extent().y1 - 1.0
