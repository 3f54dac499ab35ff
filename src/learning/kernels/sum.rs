use crate::learning::network::{Row, WIDTH};

/// Number of partial sums: the lanes of the widest vector.
pub(super) const LANES: usize = 16;

/// Sums a row in one fixed order: adds its four vectors of 16 to one vector, then sums this vector
/// by [`sum_lanes`].
#[inline(always)]
pub(super) fn sum(row: &Row) -> f32 {
    let quarters = row.as_chunks::<16>().0;
    let mut lanes = [0.0; 16];
    for (lane, sum) in lanes.iter_mut().enumerate() {
        *sum = (quarters[0][lane] + quarters[1][lane]) + (quarters[2][lane] + quarters[3][lane]);
    }
    sum_lanes(&lanes)
}

/// Sums 16 lanes: adds the upper half to the lower half until one number is left.
#[inline(always)]
pub(super) fn sum_lanes(lanes: &[f32; 16]) -> f32 {
    let eight: [f32; 8] = std::array::from_fn(|lane| lanes[lane] + lanes[lane + 8]);
    let four: [f32; 4] = std::array::from_fn(|lane| eight[lane] + eight[lane + 4]);
    (four[0] + four[2]) + (four[1] + four[3])
}

/// Sums each row of a table by adding neighbours, all rows in parallel.
#[inline(always)]
pub(super) fn sum_each(table: &[[f32; LANES]; WIDTH]) -> Row {
    let mut eight = [0.0; 8 * WIDTH];
    add_neighbours(table.as_flattened(), &mut eight);
    let mut four = [0.0; 4 * WIDTH];
    add_neighbours(&eight, &mut four);
    let mut two = [0.0; 2 * WIDTH];
    add_neighbours(&four, &mut two);
    let mut one = [0.0; WIDTH];
    add_neighbours(&two, &mut one);
    one
}

#[inline(always)]
fn add_neighbours(values: &[f32], sums: &mut [f32]) {
    for (sum, [left, right]) in sums.iter_mut().zip(values.as_chunks().0) {
        *sum = left + right;
    }
}
