use crate::learning::network::Row;

/// The sum of a row in one fixed order: four vectors of 16 into one, then halves onto halves.
#[inline(always)]
pub(super) fn sum(row: &Row) -> f32 {
    let quarters = row.as_chunks::<16>().0;
    let mut lanes = [0.0; 16];
    for (lane, sum) in lanes.iter_mut().enumerate() {
        *sum = (quarters[0][lane] + quarters[1][lane]) + (quarters[2][lane] + quarters[3][lane]);
    }
    sum_lanes(&lanes)
}

/// The sum of 16 lanes, halves onto halves.
#[inline(always)]
pub(super) fn sum_lanes(lanes: &[f32; 16]) -> f32 {
    let eight: [f32; 8] = std::array::from_fn(|lane| lanes[lane] + lanes[lane + 8]);
    let four: [f32; 4] = std::array::from_fn(|lane| eight[lane] + eight[lane + 4]);
    (four[0] + four[2]) + (four[1] + four[3])
}
