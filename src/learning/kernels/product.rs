use super::multiply_add;
use crate::elementary::InstructionSet;
use crate::elementary::Level;
use crate::learning::network::{Row, WIDTH};

/// The left factor of a product in its memory layout.
#[derive(Clone, Copy)]
pub(super) enum Left<'a> {
    /// `[row][term]`, 64 terms.
    ByRow(&'a [Row]),
    /// `[term][row]`, 64 rows.
    ByTerm(&'a [Row]),
}

/// Computes `result[row][..] = sum over terms of left(row, term) right[term][..]`.
///
/// Every product of two matrices in the networks uses this kernel: rows of the right factor are
/// vectors, entries of the left factor are broadcast, so neither factor is packed or transposed.
/// Each entry of the result is summed in the order of the terms, so the shape of the tiles does not
/// change the result's bits. The number of rows is a multiple of four.
#[inline(always)]
pub(super) fn product<I: InstructionSet, const COLUMNS: usize>(
    left: Left<'_>,
    right: &[[f32; COLUMNS]],
    result: &mut [[f32; COLUMNS]],
) {
    // The sums of a tile fill half of the registers, which hides the multiply-add's latency of four
    // cycles; on AVX-512 they fill an eighth if there are fewer columns than `WIDTH`. The compiler
    // unrolls these shapes (rows x columns) into registers, but not 8 x 32 and 8 x 16.
    match (I::LEVEL, COLUMNS) {
        (Level::Avx512, WIDTH) => tiled::<I, 64, COLUMNS>(left, right, result),
        (Level::Avx512 | Level::Avx2, _) => tiled::<I, 16, COLUMNS>(left, right, result),
        (Level::Plain, _) => tiled::<I, 8, COLUMNS>(left, right, result),
    }
}

/// Number of rows in a tile.
const TALL: usize = 4;

/// Computes the product in tiles of `TALL` rows and `WIDE` columns.
#[inline(always)]
fn tiled<I: InstructionSet, const WIDE: usize, const COLUMNS: usize>(
    left: Left<'_>,
    right: &[[f32; COLUMNS]],
    result: &mut [[f32; COLUMNS]],
) {
    assert!(result.len().is_multiple_of(TALL) && COLUMNS.is_multiple_of(WIDE));
    for (tile, result) in result.as_chunks_mut::<TALL>().0.iter_mut().enumerate() {
        for column in 0..COLUMNS / WIDE {
            let mut sums = [[0.0; WIDE]; TALL];
            match left {
                Left::ByRow(left) => {
                    let left = &left.as_chunks::<TALL>().0[tile];
                    for (term, right) in (0..WIDTH).zip(right) {
                        let right = &right.as_chunks::<WIDE>().0[column];
                        for (sum, left) in sums.iter_mut().zip(left) {
                            accumulate::<I, WIDE>(sum, left[term], right);
                        }
                    }
                }
                Left::ByTerm(left) => {
                    for (left, right) in left.iter().zip(right) {
                        let left = &left.as_chunks::<TALL>().0[tile];
                        let right = &right.as_chunks::<WIDE>().0[column];
                        for (sum, &left) in sums.iter_mut().zip(left) {
                            accumulate::<I, WIDE>(sum, left, right);
                        }
                    }
                }
            }
            for (result, sum) in result.iter_mut().zip(&sums) {
                result.as_chunks_mut::<WIDE>().0[column] = *sum;
            }
        }
    }
}

#[inline(always)]
fn accumulate<I: InstructionSet, const WIDE: usize>(
    sum: &mut [f32; WIDE],
    left: f32,
    right: &[f32; WIDE],
) {
    for (sum, &right) in sum.iter_mut().zip(right) {
        *sum = multiply_add::<I>(left, right, *sum);
    }
}
