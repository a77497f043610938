"""Statistical tests of a fit's residuals."""

import numpy as np
from scipy.stats import chi2

from tuning.identification import record

LAGS = 25  # half a second at 50 Hz: twice the dead time, where a wrong delay would show


def compute_whiteness_p(residual: record.Series, fitted: int = 0) -> float:
    """Test residuals for correlations with themselves (Ljung and Box).

    Parameters
    ----------
    residual : (n,) array
        Prediction errors.
    fitted : int
        Parameters of the noise that were fitted to them.

    Returns
    -------
    float
        Probability of correlations this large in white noise.

    Notes
    -----
    Q = n (n + 2) sum of r_k^2 / (n - k) over the lags k is a chi-square of so many degrees of
    freedom (Biometrika 65, 297 (1978)).
    """
    e = residual - residual.mean()
    n = e.size
    lags = np.arange(1, LAGS + 1)
    products = np.array([e[lag:] @ e[: n - lag] for lag in lags.tolist()])
    r = products / (e @ e)
    q = n * (n + 2) * float(np.sum(r**2 / (n - lags)))
    return float(chi2.sf(q, LAGS - fitted))


def compute_independence_p(residual: record.Series, change: record.Series) -> float:
    """Test residuals for correlations with earlier changes of the flow.

    Parameters
    ----------
    residual, change : (n,) arrays
        Prediction errors, and the change of the flow at each sample.

    Returns
    -------
    float
        Probability of correlations this large if the model were complete.
    """
    e = (residual - residual.mean()) / residual.std()
    u = change - change.mean()
    n = e.size

    # From lag 1 on: a tick's flow may respond to its own reading.
    past = np.array([u[LAGS - lag : n - lag] for lag in range(1, LAGS + 1)])
    cross = past @ e[LAGS:]

    # The changes may be correlated with each other: their covariance weighs the lags.
    square = cross @ np.linalg.pinv(past @ past.T) @ cross
    return float(chi2.sf(square, LAGS))
