"""pykalman: its filter and smoother on the first rows of one recording."""

from pykalman import KalmanFilter
from series import Arrays, Tasks, answer

ROWS = 10_000


def prepare(p: Arrays) -> Tasks:
    mean, covariance = p["A"] @ p["mean"], p["A"] @ p["covariance"] @ p["A"].T + p["Q"]  # of its first state
    item = KalmanFilter(p["A"], p["C"], p["Q"], p["R"], None, None, mean, covariance)
    return {"filter": lambda: item.filter(p["z"])[0], "smoother": lambda: item.smooth(p["z"])[0]}


if __name__ == "__main__":
    answer(prepare, ROWS)
