"""Statistical tests of a fit's residuals."""

import numpy as np
from scipy.stats import chi2

from tuning.identification import record

LAGS = 25  # half a second at 50 Hz: twice the dead time, where a wrong delay would show


def compute_whiteness_p(residual: record.Series, fitted: int = 0) -> float:
    """Ljung-Box: probability of correlations this large in white noise."""
    e = residual - residual.mean()
    n = e.size
    r = np.array([e[lag:] @ e[: n - lag] for lag in range(1, LAGS + 1)]) / (e @ e)
    q = n * (n + 2) * float(np.sum(r**2 / (n - np.arange(1, LAGS + 1))))
    return float(chi2.sf(q, LAGS - fitted))


def compute_independence_p(residual: record.Series, change: record.Series) -> float:
    """Probability of residuals this correlated with earlier changes of the flow, if the model were
    complete.
    """
    e = (residual - residual.mean()) / residual.std()
    u = change - change.mean()
    n = e.size
    # from lag 1 on: a tick's flow may respond to its own reading
    past = np.array([u[LAGS - lag : n - lag] for lag in range(1, LAGS + 1)])
    cross = past @ e[LAGS:]
    return float(chi2.sf(cross @ np.linalg.pinv(past @ past.T) @ cross, LAGS))
