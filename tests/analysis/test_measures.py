"""Measures of an option space, against closed forms, examples worked out by hand, and unrelated data."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import pdist, squareform
from scipy.stats import ortho_group

from taic_jax.analysis import measures
from taic_jax.options.losses import kl_loss

ROWS = 600


def gaussians(rows=ROWS, x_size=1, y_size=1, rho=0.0, seed=0):
    """Return standard normal x and y whose first columns correlate pairwise by rho, and whose others are unrelated."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(rows, x_size)), rng.normal(size=(rows, y_size))
    both = min(x_size, y_size)
    y[:, :both] = rho * x[:, :both] + math.sqrt(1 - rho**2) * y[:, :both]
    return x, y


@pytest.mark.parametrize("rho", [0.0, 0.4, 0.8])
def test_distance_correlation_of_the_bivariate_normal(rho):
    # Székely, Rizzo & Bakirov (2007), theorem 7.
    half = rho * math.asin(rho / 2) + math.sqrt(4 - rho**2)
    known = (rho * math.asin(rho) + math.sqrt(1 - rho**2) - half + 1) / (1 + math.pi / 3 - math.sqrt(3))
    got = [measures.distance_correlation(*gaussians(500, rho=rho, seed=seed)) for seed in range(20)]
    np.testing.assert_allclose(np.mean(got), known, atol=0.02)


def test_distance_correlation_knows_a_rotated_shifted_scaled_copy():
    x, y = gaussians(200, 4, 3, rho=0.5)
    rotation = 7.0 * ortho_group.rvs(4, random_state=1)
    assert measures.distance_correlation(x, x @ rotation + 3) == pytest.approx(1)
    plain = measures.distance_correlation(x, y)
    assert 0.02 < plain < 0.9
    assert measures.distance_correlation(x @ rotation + 3, y) == pytest.approx(plain)
    assert measures.distance_correlation(y, x) == pytest.approx(plain)


def test_distance_correlation_has_no_bias_where_the_plain_one_is_near_1():
    def centred(values):
        distances = squareform(pdist(values))
        return distances - distances.mean(0) - distances.mean(1)[:, None] + distances.mean()

    pairs = [gaussians(20, 60, 60, seed=seed) for seed in range(100)]
    got = np.array([measures.distance_correlation(x, y) for x, y in pairs])
    assert abs(got.mean()) < 4 * got.std() / 10
    assert got.min() < 0
    a, b = (centred(values) for values in pairs[0])
    assert np.vdot(a, b) / math.sqrt(np.vdot(a, a) * np.vdot(b, b)) > 0.7


def test_distance_correlation_of_equal_rows_is_0():
    assert measures.distance_correlation(np.ones((10, 2)), gaussians(10)[0]) == 0


def test_trustworthiness_by_hand():
    # Nearest in x: 0 -> 1, 1 -> 0, 2 -> 1, 3 -> 2. Their ranks in y: 2, 3, 1, 3, so the excess over k = 1 is 5.
    x, y = np.array([[0.0], [1.0], [3.0], [7.0]]), np.array([[0.0], [10.0], [11.0], [1.5]])
    assert measures.trustworthiness(x, y, k=1) == pytest.approx(1 - 2 * 5 / (4 * 1 * (8 - 3 - 1)))


def test_trustworthiness_is_1_for_a_copy_and_half_by_chance():
    x, y = gaussians(400, 3, 3)
    assert measures.trustworthiness(x, 5 * x - 2) == 1
    # A row that lies twice in x is its own neighbour's equal, and never its own neighbour.
    assert measures.trustworthiness(np.repeat(x, 2, axis=0), np.repeat(x, 2, axis=0)) == 1
    assert measures.trustworthiness(x, y) == pytest.approx(0.5, abs=0.03)


def test_trustworthiness_tells_the_direction():
    # y folds x: near in x is near in y, while neighbours in y may come from both ends of x.
    x = np.linspace(-1, 1, 300)[:, None]
    assert measures.trustworthiness(x, x**2) > 0.97
    assert measures.trustworthiness(x**2, x) < 0.8


@pytest.mark.parametrize("rho", [0.5, 0.9])
def test_linear_probe_finds_the_squared_correlation(rho):
    # The second column is unrelated, so the pooled R^2 is (rho^2 + 0) / 2.
    x, y = gaussians(20_000, 1, 2, rho)
    assert measures.linear_probe_r2(x, y[:, :1]) == pytest.approx(rho**2, abs=0.02)
    assert measures.linear_probe_r2(x, y * [1.0, 1000.0] + 5) == pytest.approx(rho**2 / 2, abs=0.02)


def test_probes_find_a_linear_map():
    x, noise = gaussians(ROWS, 6, 5)
    y = x @ np.random.default_rng(1).normal(size=(6, 5)) + 3
    assert measures.linear_probe_r2(x, y) == pytest.approx(1, abs=1e-5)
    assert measures.linear_probe_r2(1e-3 * x + 7, y) == pytest.approx(1, abs=1e-5)
    assert 0.9 < measures.mlp_probe_r2(x, y + 0.1 * noise) < 1


def test_mlp_probe_finds_a_square_where_the_linear_one_does_not():
    x, _ = gaussians()
    assert measures.linear_probe_r2(x, x**2) < 0.05
    assert measures.mlp_probe_r2(x, x**2) > 0.95


@pytest.mark.parametrize("probe", [measures.linear_probe_r2, measures.mlp_probe_r2])
def test_probes_find_nothing_in_noise(probe):
    got = [probe(*gaussians(400, 6, 8, seed=seed), seed=seed) for seed in range(3)]
    assert min(got) > -0.1
    assert max(got) < 0.01


def test_linear_probe_is_judged_by_held_out_rows():
    # With as many columns as this, a fit of the rows that it is judged by would reach R^2 = 1.
    assert measures.linear_probe_r2(*gaussians(200, 300, 4)) < 0


def test_probes_are_functions_of_the_seed():
    x, y = gaussians(100, 2, 2, rho=0.5)
    for probe in (measures.linear_probe_r2, measures.mlp_probe_r2):
        assert probe(x, y, seed=3) == probe(x, y, seed=3) != probe(x, y, seed=4)


def test_probe_leaves_out_constant_columns():
    x, y = gaussians(100, 2, 2, rho=0.8)
    padded = np.column_stack([y, np.full(100, 0.1), 3 + 1e-7 * gaussians(100, seed=5)[0]])
    assert measures.linear_probe_r2(x, padded) == pytest.approx(measures.linear_probe_r2(x, y))
    assert math.isnan(measures.linear_probe_r2(x, np.ones((100, 2))))


@pytest.mark.parametrize("rho", [0.0, 0.6, 0.9])
def test_mutual_information_of_the_bivariate_normal(rho):
    got = [measures.mutual_information(*gaussians(500, rho=rho, seed=seed)) for seed in range(20)]
    np.testing.assert_allclose(np.mean(got), -math.log(1 - rho**2) / 2, atol=0.03)


def test_mutual_information_of_pairs_is_the_sum():
    got = [measures.mutual_information(*gaussians(1000, 2, 2, rho=0.6, seed=seed)) for seed in range(5)]
    np.testing.assert_allclose(np.mean(got), -math.log(1 - 0.6**2), atol=0.06)


def test_mutual_information_knows_no_units():
    x, y = gaussians(rho=0.8)
    plain = measures.mutual_information(x, y)
    assert measures.mutual_information(1e6 * x, 3 - 1e-3 * y) == pytest.approx(plain)
    # It does not change under a bijection of either, though the estimate does a little.
    assert measures.mutual_information(x, np.exp(y)) == pytest.approx(plain, abs=0.15)


def test_mutual_information_by_hand():
    # The nearest is 4 away everywhere. Nearer than that are 1, 2, 2, 1 rows in x and 2, 1, 1, 2 in y, so the estimate
    # is psi(1) + psi(4) - psi(2) - psi(3) = (1 + 1/2 + 1/3) - 1 - (1 + 1/2).
    x, y = np.array([[-3.0], [-1.0], [1.0], [3.0]]), np.array([[-1.0], [3.0], [-3.0], [1.0]])
    assert measures.mutual_information(x, y, k=1) == pytest.approx(-2 / 3)


def test_mutual_information_has_a_ceiling():
    x, _ = gaussians()
    # psi(N) - psi(k) with k = 3: psi(3) = 1 + 1/2 - gamma.
    ceiling = math.log(ROWS) - 1 / (2 * ROWS) - (1.5 - np.euler_gamma)
    assert measures.mutual_information(x, x) == pytest.approx(ceiling, abs=1e-5)


def test_projection_keeps_information_that_many_columns_hide():
    # One direction of y, by far its strongest, carries all: -ln(1 - 0.9^2) / 2 = 0.83 nats.
    x, signal = gaussians(1000, rho=0.9)
    y = np.column_stack([10 * signal, gaussians(1000, 26, seed=3)[0] * 3])
    y = y @ ortho_group.rvs(27, random_state=0) + 50
    known = -math.log(1 - 0.9**2) / 2
    assert measures.mutual_information(x, y) < 0.6 * known
    assert measures.mutual_information(x, y, components=1) == pytest.approx(known, abs=0.12)


def test_permutation_baseline_tells_related_from_unrelated():
    x, y = gaussians(300, 2, 3, rho=0.5)
    mean, upper = measures.permutation_baseline(x, y, draws=40)
    assert (mean, upper) == measures.permutation_baseline(x, y, draws=40)
    assert abs(mean) < 0.05
    assert mean < upper < 0.2
    assert measures.mutual_information(x, y) > upper
    above = []
    for seed in range(20):
        x, y = gaussians(200, 2, 3, seed=seed)
        above.append(measures.mutual_information(x, y) > measures.permutation_baseline(x, y, draws=40)[1])
    assert sum(above) <= 4


def test_permutation_baseline_depends_on_the_data_as_the_estimate_does():
    # Equal rows bias the estimate upwards, permuted or not: that is what the baseline is for.
    x, y = (np.round(2 * values) for values in gaussians(200, 1, 1))
    mean, upper = measures.permutation_baseline(x, y, draws=40)
    assert abs(mean) > 0.1
    assert abs(measures.mutual_information(x, y) - mean) < 2 * (upper - mean) + 0.05


def test_active_dimensions_vary_with_the_window():
    x, _ = gaussians(500, 4)
    # Standard deviations of the mean of 1, 0.2, 0.05 and 0: variances 1, 0.04, 0.0025, 0. A shift is no activity.
    assert measures.active_dimensions(x * [1.0, 0.2, 0.05, 0.0] + [0.0, 0.0, 0.0, 2.0]) == 2
    assert measures.active_dimensions(np.zeros((10, 3))) == 0


def test_kl_per_dimension_sums_to_the_loss():
    rng = np.random.default_rng(0)
    mean, log_std = rng.normal(size=(2, 6, 3)).astype(np.float32)
    losses = [kl_loss(jnp.asarray(m), jnp.asarray(s)) for m, s in zip(mean, log_std, strict=True)]
    kl = measures.kl_per_dimension(mean, log_std)
    assert kl.shape == (3,)
    assert kl.sum() == pytest.approx(np.mean(losses), rel=1e-5)
    # (4 + 1 - 1) / 2 = 2, and nothing where the posterior is the prior.
    np.testing.assert_allclose(measures.kl_per_dimension([[2.0, 0.0], [-2.0, 0.0]], np.zeros((2, 2))), [2, 0])


def option_space(rows=300, seed=0):
    """Return options, starts and ends where the change is a function of the option, and the start is not."""
    rng = np.random.default_rng(seed)
    option, start = rng.normal(size=(rows, 3)), rng.normal(size=(rows, 5)) * [1.0, 1.0, 1.0, 100.0, 0.0]
    change = np.tanh(option @ rng.normal(size=(3, 5))) * [1.0, 1.0, 1.0, 100.0, 0.0]
    return option.astype(np.float32), start.astype(np.float32), (start + change).astype(np.float32)


def test_measures_of_an_option_space():
    got = measures.measure_option_space(*option_space(), seed=1)
    names = {f"{probe}/{name}" for probe in ("linear_r2", "mlp_r2") for name in ("change", "start", "end")}
    names |= {f"mutual_information/{name}" for name in ("change", "permuted", "permuted_upper")}
    assert set(got) == names | {"distance_correlation", "trustworthiness"}
    assert all(type(value) is float and math.isfinite(value) for value in got.values())
    assert got["distance_correlation"] > 0.5
    assert got["trustworthiness"] > 0.9
    assert 0.5 < got["linear_r2/change"] < got["mlp_r2/change"]
    assert got["mlp_r2/change"] > 0.9
    assert got["linear_r2/start"] < 0.05
    assert got["mlp_r2/start"] < 0.05
    # The end is the start and the change: half of its variance, about, is the option's.
    assert 0.15 < got["linear_r2/end"] < 0.6
    assert 0.15 < got["mlp_r2/end"] < 0.6
    assert got["mutual_information/change"] > 1
    assert -0.1 < got["mutual_information/permuted"] < got["mutual_information/permuted_upper"] < 0.2
    assert got == measures.measure_option_space(*option_space(), seed=1)


def test_measures_of_an_option_space_that_does_nothing_in_particular():
    _, start, end = option_space()
    got = measures.measure_option_space(option_space(seed=9)[0], start, end)
    for name in ("distance_correlation", "linear_r2/change", "linear_r2/end", "mlp_r2/change", "mlp_r2/end"):
        assert -0.1 < got[name] < 0.03, name
    assert got["trustworthiness"] == pytest.approx(0.5, abs=0.05)
    assert got["mutual_information/change"] < got["mutual_information/permuted_upper"] + 0.05


def test_units_of_the_state_do_not_matter():
    option, start, end = option_space()
    units = np.array([100.0, 0.01, 1.0, 1.0, 1.0])
    plain, scaled = (measures.measure_option_space(option, start * by, end * by) for by in (1.0, units))
    for name in plain:
        assert scaled[name] == pytest.approx(plain[name], abs=0.01), name


def test_what_is_not_finite_is_counted():
    option, start, end = option_space()
    start[[3, 5], 1], end[7, 0] = math.nan, math.inf
    with pytest.raises(ValueError, match=r"^2 of 300 rows of start are not finite"):
        measures.measure_option_space(option, start, end)
    with pytest.raises(ValueError, match=r"^1 of 300 rows of end are not finite"):
        measures.measure_option_space(option, option_space()[1], end)
    with pytest.raises(ValueError, match=r"^2 of 300 rows of y are not finite"):
        measures.distance_correlation(option, start)


BAD = {
    "x has 5 rows, y has 6": lambda: measures.distance_correlation(np.zeros((5, 1)), np.zeros((6, 1))),
    r"x must be \[rows, columns\]": lambda: measures.trustworthiness(np.zeros(5), np.zeros((5, 1))),
    "at least 4 rows, got 3": lambda: measures.distance_correlation(np.zeros((3, 1)), np.zeros((3, 1))),
    "less than half of the 20 rows, got 10": lambda: measures.trustworthiness(*gaussians(20)),
    "less than the 3 rows, got 3": lambda: measures.mutual_information(*gaussians(3)),
    "at least 25 rows, got 24": lambda: measures.mlp_probe_r2(*gaussians(24)),
    r"start has shape \(3, 2\), end has \(3, 1\)": lambda: measures.measure_option_space(
        np.zeros((3, 1)), np.zeros((3, 2)), np.zeros((3, 1))
    ),
}


@pytest.mark.parametrize("message", BAD)
def test_what_cannot_be_measured_says_so(message):
    with pytest.raises(ValueError, match=message):
        BAD[message]()
