"""The base's two processes have one name each, in whichever place a fit has left them."""

import numpy as np
import pytest

from aemd.diagnose.fit import residuals
from aemd.diagnose.hypothesis import Base, base_box, make_data
from aemd.diagnose.translate import to_model
from tests.diagnose.plant import clean, series


def test_signal_and_drift_have_their_names_in_report_and_model_also_where_a_fit_has_them_change_places():
    data = make_data(series(clean(3, 500)))
    one = np.array([np.log(0.5), 0.7, np.log(60.0), -1.6, -0.7, 0.0])
    other = one[[2, 3, 0, 1, 4, 5]]
    base = Base(one, shocks=False, box=base_box(data))

    made, turned = (to_model(residuals([base], theta, data), 0.02)[0] for theta in (one, other))
    told, again = ({item.name: item.value(theta) for item in base.parameters(data)} for theta in (one, other))

    assert turned == made
    assert [term.role for term in made.terms[1:3]] == ["signal", "internal"]
    assert made.terms[1].tau_s < made.terms[2].tau_s
    assert again == told
    assert (told["signal_tau_s"], told["drift_tau_s"]) == pytest.approx((0.5, 60.0))
    assert told["drift_rate_V_per_rt_s"] == pytest.approx(np.exp(-1.6) * data.unit_V)
