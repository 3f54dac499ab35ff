//! The assignment of rollouts to the rigs that share a session.

/// The number, from 1, of the rig that makes a candidate's rollout with the number `rollout`, from
/// 0; `None` if every rig was taken out.
///
/// The rigs take the rollouts in turn, so that each rig evaluates every candidate alike. If the rig
/// whose turn it is was taken out, the rig with the fewest rollouts so far makes the rollout; of
/// several such rigs, the rig with the lowest number. The other rigs keep their own rollouts.
///
/// The rigs in `taken_out` count as taken out from the first rollout on, so that the result depends
/// on the arguments alone.
#[must_use]
pub fn rig_of_rollout(rollout: u32, rigs: u32, taken_out: &[u32]) -> Option<u32> {
    // The rigs that were not taken out, each with its number of rollouts so far.
    let mut left: Vec<(u32, u32)> =
        (1..=rigs).filter(|rig| !taken_out.contains(rig)).map(|rig| (rig, 0)).collect();
    let mut rig = None;
    for earlier in 0..=rollout {
        let own = earlier % rigs.max(1) + 1;
        let index = match left.iter().position(|(rig, _)| *rig == own) {
            Some(index) => index,
            None => (0..left.len()).min_by_key(|&index| left[index].1)?,
        };
        left[index].1 += 1;
        rig = Some(left[index].0);
    }
    rig
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spread(rollouts: u32, rigs: u32, taken_out: &[u32]) -> Vec<u32> {
        (0..rollouts).map(|it| rig_of_rollout(it, rigs, taken_out).unwrap()).collect()
    }

    #[test]
    fn the_rigs_take_the_rollouts_in_turn() {
        assert_eq!(spread(3, 1, &[]), [1, 1, 1]);
        assert_eq!(spread(6, 3, &[]), [1, 2, 3, 1, 2, 3]);
    }

    #[test]
    fn the_other_rigs_share_the_rollouts_of_a_rig_that_is_taken_out_and_keep_their_own() {
        assert_eq!(spread(5, 2, &[1]), [2; 5]);
        assert_eq!(spread(9, 3, &[2]), [1, 3, 3, 1, 1, 3, 1, 3, 3]);
        assert_eq!(spread(4, 3, &[2, 1]), [3; 4]);
        for rigs in 1..6 {
            for taken_out in 1..=rigs {
                let (before, after) =
                    (spread(20, rigs, &[]), |out| rig_of_rollout(out, rigs, &[taken_out]));
                for made in 1..20 {
                    let by = spread(if rigs > 1 { made } else { 0 }, rigs, &[taken_out]);
                    let counts = (1..=rigs).filter(|rig| *rig != taken_out);
                    let counts = counts.map(|rig| by.iter().filter(|it| **it == rig).count());
                    let (least, most) =
                        counts.fold((20, 0), |(least, most), it| (it.min(least), it.max(most)));
                    assert!(most <= least + 2, "{made} rollouts of {rigs} rigs: {by:?}");
                }
                for (rollout, rig) in (0..).zip(before) {
                    let later = after(rollout);
                    assert_eq!(later.is_none(), rigs == 1);
                    assert_ne!(later, Some(taken_out));
                    assert!(rig == taken_out || later == Some(rig));
                }
            }
        }
    }
}
