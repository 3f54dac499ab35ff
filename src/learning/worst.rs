use super::collect::Batch;
use super::transition::{ExtraInputs, TrajectoryEnd, Transition};
use crate::qube::MAX_STEPS;

/// Selects the transitions of the trajectories with the lowest returns: `share` of the trajectories
/// that can be compared, rounded up (EPOpt's percentile, Rajeswaran et al. 2017, algorithm 1).
///
/// Trajectories are compared by their mean reward a step. A trajectory that left the box earns
/// nothing more, so its mean is over the 600 steps of a whole trajectory. A trajectory that the
/// batch's end cut short cannot be compared with a longer one and is left out: it began later in
/// the batch, after a fall, and a swing-up's first steps earn little on any Qube.
pub(super) fn worst_of(batch: &Batch, share: f32) -> Batch {
    let mut first = 0;
    let mut trajectories: Vec<(f64, usize, TrajectoryEnd)> = Vec::with_capacity(batch.ends.len());
    let mut longest = 0;
    for own in &batch.ends {
        let steps = own.last + 1 - first;
        let earned: f64 =
            batch.transitions[first..=own.last].iter().map(|it| f64::from(it.reward)).sum();
        let over = if own.left_box { MAX_STEPS } else { steps };
        if !own.left_box {
            longest = longest.max(steps);
        }
        trajectories.push((earned / over as f64, first, *own));
        first = own.last + 1;
    }
    trajectories.retain(|(_, first, own)| own.left_box || own.last + 1 - first == longest);
    // Ties stay in order, so that the same batch gives the same transitions.
    trajectories.sort_by(|one, other| one.0.total_cmp(&other.0));
    let kept = count_of_worst(trajectories.len(), share);
    trajectories.truncate(kept);
    let (mut transitions, mut extra_inputs) = (Vec::<Transition>::new(), Vec::<ExtraInputs>::new());
    let mut ends = Vec::with_capacity(kept);
    for &(_, first, own) in &trajectories {
        transitions.extend(&batch.transitions[first..=own.last]);
        extra_inputs.extend(batch.extra_inputs.get(first..=own.last).unwrap_or_default());
        ends.push(TrajectoryEnd { last: transitions.len() - 1, ..own });
    }
    Batch { transitions, extra_inputs, ends }
}

/// The number of the worst of `count` trajectories, at least one: this share of them, rounded up.
pub(super) fn count_of_worst(count: usize, share: f32) -> usize {
    ((share * count as f32).ceil() as usize).clamp(1, count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learning::network::MAX_PHYSICS_INPUTS;

    /// A batch of trajectories, each with its reward a step, its length, and whether it left the
    /// box.
    fn batch(trajectories: &[(f32, usize, bool)]) -> Batch {
        let (mut transitions, mut ends) = (Vec::new(), Vec::new());
        for &(reward, steps, left_box) in trajectories {
            transitions.extend(vec![Transition { reward, ..Transition::default() }; steps]);
            let last = transitions.len() - 1;
            ends.push(TrajectoryEnd { last, left_box, value_after: 0.0 });
        }
        Batch { transitions, extra_inputs: Vec::new(), ends }
    }

    #[test]
    fn the_worst_tenth_of_known_returns_is_kept() {
        let known: Vec<(f32, usize, bool)> =
            (0..20).map(|it| (((7 * it) % 20) as f32 / 20.0, 600, false)).collect();
        let kept = worst_of(&batch(&known), 0.1).transitions;
        assert_eq!(kept.len(), 1200);
        let rewards = [kept[0].reward, kept[600].reward];
        assert_eq!(rewards, [0.0, 0.05]);
    }

    #[test]
    fn a_fall_is_worse_than_a_trajectory_that_was_cut_short() {
        let kept = worst_of(&batch(&[(0.9, 300, false), (0.9, 300, true), (0.8, 600, false)]), 0.3);
        assert_eq!(kept.transitions.len(), 300);
        let fallen = worst_of(&batch(&[(0.9, 100, false), (0.9, 400, true)]), 0.5);
        assert_eq!(fallen.transitions.len(), 400);
    }

    #[test]
    fn the_rest_of_a_batch_after_a_fall_is_not_among_the_worst() {
        // The trajectory of 50 steps began after a fall and earned little, as every swing-up does.
        let kept = worst_of(
            &batch(&[(0.9, 550, true), (0.1, 50, false), (0.7, 600, false), (0.9, 600, false)]),
            0.5,
        );
        assert_eq!(kept.ends.len(), 2);
        assert!(kept.transitions.iter().all(|it| it.reward > 0.5));
        assert_eq!(kept.transitions.len(), 550 + 600);
    }

    #[test]
    fn physics_inputs_stay_with_their_transitions() {
        let mut all = batch(&[(0.9, 2, false), (0.1, 3, true)]);
        all.extra_inputs = (0..5).map(|index| [index as f32; MAX_PHYSICS_INPUTS]).collect();
        let kept = worst_of(&all, 0.5);
        assert_eq!(kept.extra_inputs[..], all.extra_inputs[2..]);
        assert_eq!(kept.ends, [TrajectoryEnd { last: 2, left_box: true, value_after: 0.0 }]);
    }
}
