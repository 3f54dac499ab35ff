//! Which rig makes which rollout, where several rigs share a session.

/// The rig, from 1, that makes a candidate's rollout of this number; `None` if no rig is left.
///
/// Rollouts go round the rigs in turn, so that each rig evaluates every candidate alike. A rollout of a rig that was
/// taken out goes to one of the others, again in turn; the rollouts of those others stay theirs.
#[must_use]
pub fn rig_of_rollout(rollout: u32, rigs: u32, taken_out: &[u32]) -> Option<u32> {
    let own = rollout % rigs.max(1) + 1;
    if !taken_out.contains(&own) {
        return Some(own);
    }
    let left: Vec<u32> = (1..=rigs).filter(|rig| !taken_out.contains(rig)).collect();
    let round = (rollout / rigs.max(1)) as usize;
    left.get(round.checked_rem(left.len())?).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spread(rollouts: u32, rigs: u32, taken_out: &[u32]) -> Vec<u32> {
        (0..rollouts).map(|it| rig_of_rollout(it, rigs, taken_out).unwrap()).collect()
    }

    #[test]
    fn rollouts_go_round_the_rigs() {
        assert_eq!(spread(3, 1, &[]), [1, 1, 1]);
        assert_eq!(spread(6, 3, &[]), [1, 2, 3, 1, 2, 3]);
    }

    #[test]
    fn the_rollouts_of_a_rig_that_is_taken_out_go_round_the_others_which_keep_theirs() {
        assert_eq!(spread(5, 2, &[1]), [2; 5]);
        assert_eq!(spread(9, 3, &[2]), [1, 1, 3, 1, 3, 3, 1, 1, 3]);
        assert_eq!(spread(4, 3, &[2, 1]), [3; 4]);
        for rigs in 1..6 {
            for taken_out in 1..=rigs {
                let (before, after) =
                    (spread(20, rigs, &[]), |out| rig_of_rollout(out, rigs, &[taken_out]));
                for (rollout, rig) in (0..).zip(before) {
                    let now = after(rollout);
                    assert_eq!(now.is_none(), rigs == 1);
                    assert_ne!(now, Some(taken_out));
                    assert!(rig == taken_out || now == Some(rig));
                }
            }
        }
    }
}
