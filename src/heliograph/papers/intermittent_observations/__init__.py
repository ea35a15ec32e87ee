"""Kalman filtering with intermittent observations and its successors, reproduced and judged; see README.md."""
