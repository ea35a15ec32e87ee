"""Linear systems with random coefficients: their best linear filters, lifts to monomials, schedules of gains."""
