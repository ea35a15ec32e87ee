"""Tests of the judgement of declared covariances."""
