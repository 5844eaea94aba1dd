from pathlib import Path

import pytest

from mcdenoise.report.views import Range, Row, View, front, shortlist, views
from mcdenoise.results import Cell, Method, Results, Spread


@pytest.mark.parametrize(("metric", "sign"), [("SMAPE", 1), ("PSNR", -1)])
def test_front_of_known_points(metric: str, sign: int):
    #         dominated by 1    front       front       dominated    tie in cost, worse   costly and worst
    values = [(2.0, 9.0), (1.0, 8.0), (4.0, 3.0), (5.0, 3.0), (4.0, 4.0), (9.0, 8.5)]
    method = Method("one", "fixed", "one", "one")
    rows = [
        Row(method, number, {metric: Range(sign * error, 0, 0)}, Range(time, 0, 0))
        for number, (time, error) in enumerate(values)
    ]
    assert [row.number for row in front(View("", rows), metric)] == [1, 2]


def test_mean_over_scenes(folder: Path):
    results = Results.read(folder)
    mean, first, second = views(results)
    assert [view.name for view in (mean, first, second)] == ["mean of 2 scenes", "first", "second"]
    for one, other, both in zip(first.rows[:3], second.rows[:3], mean.rows[:3], strict=True):
        for metric in ("SMAPE", "PSNR"):
            expected = (one.errors[metric].value + other.errors[metric].value) / 2
            assert both.errors[metric].value == pytest.approx(expected, rel=1e-12)
    # The time is that without files: the network alone, 10 ms of the second method, with its quartiles.
    assert mean.rows[1].milliseconds == Range(10.0, 9.0, 12.0)
    assert mean.rows[1].throughput == pytest.approx(96 * 64 / 0.010 / 1e6)


def test_a_page_has_the_best_setting_of_each_model_and_the_front(folder: Path):
    results = Results.read(folder)
    assert shortlist(results, len(results.methods)) is results
    # Twenty settings of two models: errors fall with the number, and times rise with it but for the last two of ten.
    for model, base in (("oidn", 0.5), ("late", 0.9)):
        for number in range(10):
            name = f"{model}({number})"
            results.methods.append(Method(name, "fixed", name, model, {"number": number}))
            error, time = base - number / 100, 1000.0 if number > 7 else number + (1 if model == "oidn" else 100)
            for scene in ("first", "second"):
                took = Spread(time, time, time, 1)
                results.cells.append(Cell(scene, name, {"SMAPE": error}, {}, took, {"network": took}, computing=took))
    names = [method.name for method in shortlist(results, 12).methods]
    assert {"noisy", "ours", "oidn(0)", "late(9)"} <= set(names)
    assert len(names) <= 12
    assert names == [method.name for method in results.methods if method.name in names]
    assert "late(3)" not in names
    assert shortlist(results, 3).methods[0].name == "noisy"
    assert {cell.method for cell in shortlist(results, 3).cells} <= {m.name for m in shortlist(results, 3).methods}
