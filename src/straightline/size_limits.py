"""Sizes that decide how a program is written, and what is refused: each says what was measured.

Most separate numbers that are written out, one operation each, from arrays in memory that loops go through: writing
out is several times as fast, and takes LLVM 0.1 ms an operation.
"""


def divide_rounded_up(a: int, b: int) -> int:
    """Return a / b rounded up to an integer; b is positive."""
    return -(-a // b)


# Turns of the scan of `compile_scan`, of which code learns the number when it is called: no array in memory is as long.
ANY_LENGTH = 2**31 - 1

# Operations of a program, and of half of those made while it is folded: of 120,000 LLVM takes half as long as XLA, 0.1
# ms each; a refusal comes after some 4 s.
LONGEST = 200_000
# Lines of a basic block, where nothing jumps: in haste LLVM takes longer for each the more they are. Without a limit
# the least of 20 numbers, of 220 arrays in one program (55,000 lines), took it 3.7 s; in blocks of 300, 500, 1,000 and
# 3,000 lines 0.46 to 0.62. A filter with branches (21,000 lines) took 0.38, then 0.31 to 0.37. With care it takes as
# long, and so does the code that it makes.
LONGEST_BASIC_BLOCK = LONGEST // 400
# Executions of each operation after which care pays: it takes LLVM 20 to 90 us an operation more, and saves 0.03 to 0.3
# ns for a block of runs. Of thirteen filters of 180 to 42,000 operations, it pays after 160,000 to 1,600,000.
OFTEN = 200_000
# Operations of a step of one plant above which care seldom pays: LLVM takes four to ten times as long (for 300
# particles of two states, 77,000 operations, 41 s instead of 4) to save a third to half of its 0.25 ms. So with care
# the longest takes as long as the longest of all programs in haste.
ALONE = LONGEST // 10
# Operations of vectors in a thread's part of a call, 100 us: to wake a thread takes 30, and a processor that others use
# 60 more in all.
LITTLE = 400_000

# Numbers of a known array that are constants, a longer one is a table in memory; rows of a matrix that is loaded whole.
# Sums of products by 64 known numbers take 21 ns a run written out and 23 in memory; by 512 152 and 220, made in 0.13 s
# and 0.02.
TABLE = 64
LOADED = TABLE**2
# Numbers that all iterations of a loop compute, written out; of an array that a loop carries outside memory; terms of a
# product by a known matrix in memory, its zeros left out; entries that updates at indices of the data may change. The
# noise of 32 outputs, 64 columns, in memory: 75 us a step and run, and 2.5 s of LLVM, for 103 and 6.1 written out; as
# known to be of its own for each of 64 outputs 2 us written out, for 2.0 ms.
WRITTEN_OUT = 2000
# Terms of a product of numbers, or operations of a function in the place of another, that are written out: above that a
# quarter of the longest program would be this one.
MANY_TERMS = LONGEST // 4
# Rows of a matrix whose eigenvalues are written out, numbers that are sorted, and indices that data choose among, by
# comparing each with each: of 20 rows the library's method is as fast.
FEW = 20
# Operations of a branch: one that has fewer is computed in any case, a jump past it would take as long. Of an event
# filter all from 0 to 1,000 take the same time to 5 %.
DEAR = 100
