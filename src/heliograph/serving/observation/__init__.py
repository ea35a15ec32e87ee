"""Running services observed: what is wrong with each plant, as a page and as metrics, and tests of covariances."""
