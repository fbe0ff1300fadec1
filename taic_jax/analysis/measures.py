"""Measures of an option space: the information in an option's code about its effects, and its smoothness.

Rows are windows; x [N, D] is the option and y [N, P] the state change, as a rule. Only the MLP probe runs in JAX.
Distances between all rows take N^2 numbers of 8 bytes: of more than some 2000 rows draw a sample. Shapes that do not
fit, too few rows, and rows with a number that is not finite raise ValueError.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from numpy.typing import ArrayLike
from scipy.spatial import distance
from scipy.special import digamma

from taic_jax.networks import MLP, apply

ACTIVE_VARIANCE, RIDGE_PENALTY = 0.01, 1e-3
MLP_SIZES, MLP_STEPS, MLP_LEARNING_RATE = (64, 64), 300, 3e-3
PERMUTATIONS, COMPONENTS = 50, 3


def measure_option_space(option: ArrayLike, start: ArrayLike, end: ArrayLike, seed: int = 0) -> dict[str, float]:
    """Return every measure of N options [N, D], N >= 25, and of the states [N, P] at the ends of their windows.

    Change (end - start), start and end are each standardised column by column, and constant columns become 0. Options
    are not: the prior is their scale, and a dimension that the posterior ignores must not grow to the size of others.

    Keys: `distance_correlation` and `trustworthiness` of option and change; `linear_r2/NAME` and `mlp_r2/NAME` of
    change, start and end, each from the option; `mutual_information/change` of the option and the first 3 principal
    components of the change, with `mutual_information/permuted` (mean) and `mutual_information/permuted_upper` (95 %
    quantile) for permuted rows of the change. `seed` draws the probes' held-out rows, the MLP and the permutations.
    """
    option, start = _pair(option, start, "option", "start")
    end = _finite_rows(end, "end")
    if start.shape != end.shape:
        raise ValueError(f"start has shape {start.shape}, end has {end.shape}")
    change, start, end = (standardized(y, y) for y in (end - start, start, end))
    targets = {"change": change, "start": start, "end": end}
    mean, upper = permutation_baseline(option, change, seed=seed, components=COMPONENTS)
    return {
        "distance_correlation": distance_correlation(option, change),
        "trustworthiness": trustworthiness(option, change),
        **{f"linear_r2/{name}": linear_probe_r2(option, y, seed) for name, y in targets.items()},
        **{f"mlp_r2/{name}": mlp_probe_r2(option, y, seed) for name, y in targets.items()},
        "mutual_information/change": mutual_information(option, change, components=COMPONENTS),
        "mutual_information/permuted": mean,
        "mutual_information/permuted_upper": upper,
    }


def distance_correlation(x: ArrayLike, y: ArrayLike) -> float:
    """Return the squared distance correlation, corrected for bias (Székely & Rizzo, 2013; U-centred as in 2014).

    0 for independent and 1 for similar point clouds (equal up to rotation, shift and one scale). The plain statistic
    of Székely, Rizzo & Bakirov (2007) tends to 1 with the number of columns even for independent ones. The corrected
    one may fall a little below 0, so no root is taken: it estimates the square, on the scale of R^2. It needs 4 rows,
    and is 0 if all rows of x or of y are equal.
    """
    x, y = _pair(x, y)
    if len(x) < 4:
        raise ValueError(f"distance correlation needs at least 4 rows, got {len(x)}")
    a, b = _u_centred(x), _u_centred(y)
    scale = np.sqrt(np.vdot(a, a) * np.vdot(b, b))
    return float(np.vdot(a, b) / scale) if scale > 0 else 0.0


def trustworthiness(x: ArrayLike, y: ArrayLike, k: int = 10) -> float:
    """Return the degree to which neighbours in x are neighbours in y as well (Venna & Kaski, 2001).

    1 - 2 / (N k (2N - 3k - 1)) sum_i sum_{j in U_i} (r(i, j) - k), where U_i holds those of the k rows nearest to i
    in x that are not among the k nearest in y, k < N / 2, and r(i, j) is j's rank from i in y (1 is nearest). At 1 near
    options change the state nearly alike; unrelated x and y give about 0.5. With x and y exchanged it is the
    continuity: at 1 near changes come from near options.
    """
    x, y = _pair(x, y)
    rows = len(x)
    if not 1 <= k < rows / 2:
        raise ValueError(f"k must be at least 1 and less than half of the {rows} rows, got {k}")
    neighbours = _distances(x, "euclidean").argsort(axis=1, kind="stable")[:, 1 : k + 1]
    ranks = _distances(y, "euclidean").argsort(axis=1, kind="stable").argsort(axis=1)
    excess = np.maximum(np.take_along_axis(ranks, neighbours, 1) - k, 0)
    return float(1 - 2 * excess.sum() / (rows * k * (2 * rows - 3 * k - 1)))


def linear_probe_r2(x: ArrayLike, y: ArrayLike, seed: int = 0) -> float:
    """Return the R^2, on held-out rows, of ridge regression from x to y: a linear probe (Alain & Bengio, 2017).

    A fifth of the rows (N >= 25), drawn by the seed, is held out. All columns are standardised by mean and standard
    deviation of the other rows, for training, and the penalty is 0.001 per row. R^2 = 1 - sum (y - prediction)^2 /
    sum y^2, over all held-out rows and columns: varying columns weigh about alike, the mean of the training rows
    scores exactly 0, worse predictions less, and a constant y NaN.

    Rows of one episode are alike: held-out rows from episodes of the training rows flatter a probe.
    """
    x, y, held_out_x, held_out_y = _split(x, y, seed)
    gram = x.T @ x / len(x) + RIDGE_PENALTY * np.eye(x.shape[1])
    weights = np.linalg.solve(gram, x.T @ y / len(x))
    return _r2(held_out_x @ weights, held_out_y)


def mlp_probe_r2(x: ArrayLike, y: ArrayLike, seed: int = 0) -> float:
    """Return the R^2 of `linear_probe_r2`, on the same held-out rows, of a freshly trained MLP.

    It has two hidden layers of 64 and takes 300 steps of Adam on all training rows but a fifth; this fifth chooses
    the step whose parameters predict (early stopping; Prechelt, 1998). An untrained MLP predicts nearly 0, so for
    unrelated x and y an early step is chosen, and R^2 is near 0. With a state as y it is a newly trained F, and may
    find information that F, trained against a moving encoder, missed.
    """
    x, y, held_out_x, held_out_y = (jnp.asarray(part, jnp.float32) for part in _split(x, y, seed))
    stop = len(x) // 5
    predicted = _mlp_predictions(jax.random.key(seed), x[stop:], y[stop:], x[:stop], y[:stop], held_out_x)
    return _r2(np.asarray(predicted, np.float64), np.asarray(held_out_y, np.float64))


def mutual_information(x: ArrayLike, y: ArrayLike, k: int = 3, components: int | None = None) -> float:
    """Return the mutual information of x and y in nats, by the first estimator of Kraskov et al. (2004).

    Distances are by the maximum norm. The estimate has little bias for few columns; with tens it falls far short of
    the truth, as the k-th neighbour is then hardly nearer than any other row. Therefore y is projected onto so many
    first principal `components`, if any: their information about x is a lower bound, and can be estimated. Strong
    relations are underestimated too (Gao et al., 2015): no estimate exceeds psi(N) - psi(k), about ln(N / k), unless
    equal rows bias it upwards. More neighbours k < N lower the variance and raise the bias.
    """
    return _kraskov(*_max_norms(x, y, k, components), k)


def permutation_baseline(
    x: ArrayLike, y: ArrayLike, draws: int = PERMUTATIONS, seed: int = 0, k: int = 3, components: int | None = None
) -> tuple[float, float]:
    """Return mean and 95 % quantile of `mutual_information` for permuted rows of y (François et al., 2006)."""
    x_distances, y_distances = _max_norms(x, y, k, components)
    rng = np.random.default_rng(seed)
    orders = (rng.permutation(len(y_distances)) for _ in range(draws))
    values = [_kraskov(x_distances, y_distances[np.ix_(order, order)], k) for order in orders]
    return float(np.mean(values)), float(np.quantile(values, 0.95))


def active_dimensions(mean: ArrayLike) -> int:
    """Return the number of dimensions of q(o|a) whose means [N, D] have Var > 0.01 (Burda et al., 2016)."""
    return int(np.sum(np.var(_finite_rows(mean, "mean"), axis=0) > ACTIVE_VARIANCE))


def kl_per_dimension(mean: ArrayLike, log_std: ArrayLike) -> np.ndarray:
    """Return each dimension's share [D] of L_KL (eq. 2) in nats, the mean over windows (Kingma & Welling, 2014, B).

    KL(N(m, s^2) || N(0, 1)) = (m^2 + s^2 - 1) / 2 - ln s, where m and ln s are the posterior's [N, D].
    """
    mean, log_std = _pair(mean, log_std, "mean", "log_std")
    return np.mean((mean**2 + np.exp(2 * log_std) - 1) / 2 - log_std, axis=0)


def _finite_rows(values: ArrayLike, name: str) -> np.ndarray:
    values = np.asarray(values, np.float64)
    if values.ndim != 2:
        raise ValueError(f"{name} must be [rows, columns], got shape {values.shape}")
    if bad := np.count_nonzero(~np.isfinite(values).all(axis=1)):
        raise ValueError(f"{bad} of {len(values)} rows of {name} are not finite")
    return values


def _pair(x: ArrayLike, y: ArrayLike, x_name: str = "x", y_name: str = "y") -> tuple[np.ndarray, np.ndarray]:
    x, y = _finite_rows(x, x_name), _finite_rows(y, y_name)
    if len(x) != len(y):
        raise ValueError(f"{x_name} has {len(x)} rows, {y_name} has {len(y)}")
    return x, y


def standardized(values: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return values scaled to mean 0 and standard deviation 1 on the reference's rows; constant columns become 0."""
    std = reference.std(axis=0)
    # A constant of the physics varies by float32's rounding, which would look like a signal when scaled up.
    varies = std > 1e-8 + 1e-6 * np.abs(reference).max(axis=0)
    return np.where(varies, (values - reference.mean(axis=0)) / np.where(varies, std, 1.0), 0.0)


def _split(x: ArrayLike, y: ArrayLike, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return x and y of the training rows, then of the held-out fifth, standardised by the training rows."""
    x, y = _pair(x, y)
    if len(x) < 25:
        raise ValueError(f"a probe needs at least 25 rows, got {len(x)}")
    held_out, train = np.split(np.random.default_rng(seed).permutation(len(x)), [len(x) // 5])
    x, y = standardized(x, x[train]), standardized(y, y[train])
    return x[train], y[train], x[held_out], y[held_out]


def _r2(predicted: np.ndarray, y: np.ndarray) -> float:
    total = np.sum(y**2)
    return float(1 - np.sum((y - predicted) ** 2) / total) if total > 0 else float("nan")


@jax.jit
def _mlp_predictions(
    key: Array, x: Array, y: Array, stop_x: Array, stop_y: Array, held_out: Float[Array, "H D"]
) -> Float[Array, "H P"]:
    """Train on x [M, D] and y [M, P]; predict with the parameters of the lowest loss on stop_x and stop_y."""
    network = MLP((*MLP_SIZES, y.shape[-1]), last_scale=0.01)
    optimizer = optax.adam(MLP_LEARNING_RATE)

    def loss(params: Any, inputs: Array, outputs: Array) -> Array:
        return jnp.mean(jnp.square(apply(network, params, inputs) - outputs))

    def step(carry: Any, _: None) -> tuple[Any, None]:
        params, state, best, lowest = carry
        stop_loss = loss(params, stop_x, stop_y)
        best = jax.tree.map(lambda new, old: jnp.where(stop_loss < lowest, new, old), params, best)
        with jax.numpy_dtype_promotion("standard"):  # Optax raises a float to an integer power
            updates, state = optimizer.update(jax.grad(loss)(params, x, y), state)
        return (optax.apply_updates(params, updates), state, best, jnp.minimum(lowest, stop_loss)), None

    params = network.init(key, x)
    carry = (params, optimizer.init(params), params, jnp.float32(jnp.inf))
    (_, _, best, _), _ = jax.lax.scan(step, carry, None, MLP_STEPS)
    return apply(network, best, held_out)


def _distances(values: np.ndarray, metric: Any) -> np.ndarray:
    """Return distances [N, N] between rows, with -1 from a row to itself: it comes before its duplicates."""
    # Joint distances need x and y on one scale; one factor for all columns leaves their proportions as they are.
    distances = distance.squareform(distance.pdist(values / (np.sqrt(values.var(axis=0).mean()) or 1.0), metric))
    np.fill_diagonal(distances, -1.0)
    return distances


def _u_centred(values: np.ndarray) -> np.ndarray:
    """Return distances [N, N] centred such that inner products are unbiased."""
    distances = distance.squareform(distance.pdist(values))
    sums = distances.sum(axis=1) / (len(values) - 2)
    centred = distances - sums[:, None] - sums + sums.sum() / (len(values) - 1)
    np.fill_diagonal(centred, 0.0)
    return centred


def _max_norms(x: ArrayLike, y: ArrayLike, k: int, components: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Return distances [N, N] by the maximum norm in x, and in y or its first principal components."""
    x, y = _pair(x, y)
    if not 1 <= k < len(x):
        raise ValueError(f"k must be at least 1 and less than the {len(x)} rows, got {k}")
    projected: np.ndarray = y
    if components is not None:
        centred = y - y.mean(axis=0)
        projected = centred @ np.linalg.svd(centred, full_matrices=False)[2][:components].T
    return _distances(x, "chebyshev"), _distances(projected, "chebyshev")


def _kraskov(x_distances: np.ndarray, y_distances: np.ndarray, k: int) -> float:
    """Return psi(k) + psi(N) - <psi(n_x + 1) + psi(n_y + 1)> from distances [N, N] (Kraskov et al., 2004, eq. 8)."""
    # A row itself, at -1, is nearest: the k-th neighbour has index k, and the counts below are n + 1.
    radius = np.partition(np.maximum(x_distances, y_distances), k, axis=1)[:, k, None]
    counts = [np.count_nonzero(distances < radius, axis=1) for distances in (x_distances, y_distances)]
    return float(digamma(k) + digamma(len(radius)) - np.mean(digamma(counts[0]) + digamma(counts[1])))
