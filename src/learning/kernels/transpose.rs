use crate::learning::network::{Row, WIDTH};

/// Transposes the matrix `rows` into `columns`, both of WIDTH x WIDTH; `scratch` is overwritten.
///
/// Interleaving the four quarters of an array moves the two highest bits of each entry's index to
/// the low end. An index has twelve bits, six for the row and six for the column, so three passes
/// exchange row and column. Compilers vectorise interleaving well.
#[inline(always)]
pub(super) fn transpose(
    rows: &[Row; WIDTH],
    columns: &mut [Row; WIDTH],
    scratch: &mut [Row; WIDTH],
) {
    interleave_quarters(rows, columns);
    interleave_quarters(columns, scratch);
    interleave_quarters(scratch, columns);
}

/// Interleaves the four quarters of an array. The loop walks the quarters side by side. With
/// indices into the whole array, the loop would check four indices for each entry, and the code
/// around the loop would decide whether the compiler vectorises it.
#[inline(always)]
fn interleave_quarters(from: &[Row; WIDTH], to: &mut [Row; WIDTH]) {
    let [first, second, third, fourth] =
        std::array::from_fn(|quarter| from[quarter * WIDTH / 4..][..WIDTH / 4].as_flattened());
    let to = to.as_flattened_mut().as_chunks_mut::<4>().0;
    let quarters = first.iter().zip(second).zip(third).zip(fourth);
    for (to, (((first, second), third), fourth)) in to.iter_mut().zip(quarters) {
        *to = [*first, *second, *third, *fourth];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_change_places_across_the_diagonal() {
        let at = |row: usize, column: usize| (row * WIDTH + column) as f32;
        let rows = std::array::from_fn(|row| std::array::from_fn(|column| at(row, column)));
        let (mut columns, mut scratch) = ([[0.0; WIDTH]; WIDTH], [[0.0; WIDTH]; WIDTH]);
        transpose(&rows, &mut columns, &mut scratch);
        for (column, entries) in columns.iter().enumerate() {
            assert_eq!(*entries, std::array::from_fn(|row| at(row, column)));
        }
    }
}
