#![allow(
    clippy::needless_range_loop,
    reason = "a lane indexes many arrays at once, and plain index loops become vector code"
)]

use super::SensorModel;
use super::lane_observer::{LaneObserver, ObserverLanes};
use crate::estimation::{FilterGains, through_filters};
use crate::qube::{BLOCK, CONTROL_PERIOD_S, InLanes, Lanes, State, quantised};

/// What lies between the states of a block and what policy and guard see of them.
#[derive(Clone, Debug)]
pub(super) struct Sensors {
    /// The guard's filter; none where both see the true state.
    guard: Option<FilterGains<f32>>,
    /// The policy's filter where it is a slower one.
    slow: Option<FilterGains<f32>>,
    /// The policy's observer.
    observer: Option<LaneObserver>,
}

/// What is made of the states of a block.
#[derive(Clone, Copy, Debug)]
pub(super) struct SeenLanes {
    /// By policy and reward.
    pub(super) seen: State<Lanes>,
    /// By the guard.
    pub(super) guarded: State<Lanes>,
}

impl SeenLanes {
    /// Both are these.
    pub(super) fn both(state: &State<f32>) -> Self {
        Self { seen: State::all(state), guarded: State::all(state) }
    }

    /// Both start anew in a lane.
    pub(super) fn restart(&mut self, lane: usize, state: &State<f32>) {
        self.seen.set_lane(lane, state);
        self.guarded.set_lane(lane, state);
    }
}

impl Sensors {
    pub(super) fn new(model: &SensorModel) -> Self {
        let SensorModel::Encoders { estimator } = model else {
            return Self { guard: None, slow: None, observer: None };
        };
        let gains = |corner_rad_s| FilterGains::new(corner_rad_s, CONTROL_PERIOD_S).cast();
        let filters = estimator.observer.is_none() && !estimator.policy_sees_as_guard();
        Self {
            guard: Some(gains(estimator.guard_corner_rad_s())),
            slow: filters.then(|| gains(estimator.corner_rad_s)),
            observer: estimator.observer.as_ref().map(LaneObserver::new),
        }
    }

    /// Whether blocks need the memory of an observer.
    pub(super) fn observe(&self) -> bool {
        self.observer.is_some()
    }

    /// What is seen of a state at the start of a trajectory: the estimator takes the first
    /// measurement as one at rest, here as on the machine.
    pub(super) fn first(&self, state: &State<f32>) -> State<f32> {
        match self.guard {
            None => *state,
            Some(_) => State {
                theta: quantised(state.theta),
                alpha: quantised(state.alpha),
                theta_dot: 0.0,
                alpha_dot: 0.0,
            },
        }
    }

    /// One sample later. `observers` is the memory of the block's observers where they need one,
    /// `voltages_v` the commands of the period that is over.
    #[inline(always)]
    pub(super) fn look(
        &self,
        state: &State<Lanes>,
        lanes: &mut SeenLanes,
        observers: Option<&mut ObserverLanes>,
        voltages_v: &Lanes,
    ) {
        let Some(guard) = &self.guard else {
            // Lane by lane: whole structures are copied by a call, which costs some per cent of a step.
            for lane in 0..BLOCK {
                let one = state.lane(lane);
                lanes.seen.set_lane(lane, &one);
                lanes.guarded.set_lane(lane, &one);
            }
            return;
        };
        filter(&mut lanes.guarded, state, guard);
        match (&self.observer, observers, &self.slow) {
            (Some(observer), Some(memory), _) => {
                lanes.seen = observer.update(memory, voltages_v, &lanes.guarded);
            }
            (_, _, Some(slow)) => filter(&mut lanes.seen, state, slow),
            _ => lanes.seen = lanes.guarded,
        }
    }
}

#[inline(always)]
fn filter(seen: &mut State<Lanes>, state: &State<Lanes>, gains: &FilterGains<f32>) {
    for lane in 0..BLOCK {
        let (theta, alpha) = (quantised(state.theta[lane]), quantised(state.alpha[lane]));
        let now = through_filters(&seen.lane(lane), theta, alpha, gains);
        seen.set_lane(lane, &now);
    }
}
