"""Sizes that decide how a program is written, and what is refused: each says what was measured, or what it weighs.

Most separate numbers that are written out, one operation each, from arrays in memory that loops go through: writing
out is several times as fast, and takes LLVM 0.1 ms an operation.
"""

# Operations made while a program is folded, constants and what is dropped again among them. A refusal comes after some
# 4 s then.
MADE = 400_000
# Operations of a program: of 120,000 LLVM takes half as long as XLA, 0.1 ms each.
LONGEST = 200_000
# Executions of each operation after which care pays: it takes LLVM 20 to 90 us an operation more, and saves a seventh
# to a half of its time, 0.03 to 0.3 ns for a block of runs. Of thirteen filters of 180 to 42,000 operations, it pays
# after 160,000 to 1,600,000; of small ones it takes milliseconds, and comes sooner: OFTEN of programs of LARGE
# operations, in proportion down to SMALL.
OFTEN, SMALL, LARGE = 500_000, 1_000, 10_000
# Operations of a step of one plant above which care seldom pays: LLVM takes four to nine times as long (for 300
# particles of two states, 77,000 operations, 41 s instead of 4) to save a third to half of its 0.25 ms.
ALONE = 20_000
# Operations of vectors in a call: fewer are done sooner than other threads are woken.
LITTLE = 100_000
# Lines of 64 bytes that a turn of a loop asks for, of one array: more of them are moved in a loop so short that nothing
# is hidden beside it.
LINES = 16

# Numbers of a known array: a longer one is a table in memory.
TABLE = 64
# Numbers of an array in memory that is loaded whole.
LOADED = 4096
# Numbers that all turns of a loop compute, written out; of an array that a loop carries outside memory; terms of a
# product by a known matrix in memory, its zeros left out: of the noise of 64 links on their own, 2.0 ms a step and run
# as a loop over rows, 2 us written out.
WRITTEN_OUT = 2000
# Terms of a product of numbers, or operations of a function in the place of another, that are written out: above that a
# quarter of the longest program would be this one.
MANY_TERMS = LONGEST // 4
# Rows of a matrix whose eigenvalues are written out, and numbers that are sorted by comparing each with each: of 20
# rows the straight line is long, and the library's method as fast.
ROWS = 20
# Places that a number found in the data may choose among, one comparison each; more are in memory.
PLACES = 16
# Entries that updates at places of the data may change, one selection each.
CHANGED = 500
# Nodes of a branch: one that has fewer is computed in any case, and one that is SHARE times smaller than the dearest,
# which often has its numbers within.
DEAR, SHARE = 100, 4
