#![allow(
    clippy::needless_range_loop,
    reason = "a lane indexes many arrays at once, and plain index loops become vector code"
)]

use super::SensorModel;
use super::lane_observer::{LaneObserver, ObserverLanes};
use crate::estimation::{FilterGains, through_filters};
use crate::qube::{BLOCK, CONTROL_PERIOD_S, InLanes, Lanes, PlantModel, Quantiser, State};

/// The encoders and estimators that turn the true states of a block into the states that policy and
/// guard see.
#[derive(Clone, Debug)]
pub(super) struct Sensors {
    /// Gains of the guard's filter; `None` where policy and guard see the true state.
    guard: Option<FilterGains<f32>>,
    /// Gains of the policy's filter, if it is slower than the guard's.
    slow: Option<FilterGains<f32>>,
    /// Observer of the policy, if it has one.
    observer: Option<LaneObserver>,
    /// Rounding of the angles of arm and pendulum to the counts of their encoders.
    theta: Quantiser<f32>,
    alpha: Quantiser<f32>,
}

/// The states of a block as sensors and estimators show them.
#[derive(Clone, Copy, Debug)]
pub(super) struct SeenLanes {
    /// States for policy and reward.
    pub(super) seen: State<Lanes>,
    /// States for the guard.
    pub(super) guarded: State<Lanes>,
}

impl SeenLanes {
    /// The same state for policy and guard, in all lanes.
    pub(super) fn both(state: &State<f32>) -> Self {
        Self { seen: State::all(state), guarded: State::all(state) }
    }

    /// Restarts one lane, with this state for both policy and guard.
    pub(super) fn restart(&mut self, lane: usize, state: &State<f32>) {
        self.seen.set_lane(lane, state);
        self.guarded.set_lane(lane, state);
    }
}

impl Sensors {
    pub(super) fn new(model: &SensorModel, plant: &PlantModel) -> Self {
        let (theta, alpha) = (plant.encoders.theta.quantiser(), plant.encoders.alpha.quantiser());
        let SensorModel::Encoders { estimator } = model else {
            return Self { guard: None, slow: None, observer: None, theta, alpha };
        };
        let gains = |corner_rad_s| FilterGains::new(corner_rad_s, CONTROL_PERIOD_S).cast();
        let filters = estimator.observer.is_none() && !estimator.policy_sees_as_guard();
        Self {
            guard: Some(gains(estimator.guard_corner_rad_s())),
            slow: filters.then(|| gains(estimator.corner_rad_s)),
            observer: estimator.observer.as_ref().map(|own| LaneObserver::new(own, plant)),
            theta,
            alpha,
        }
    }

    /// Returns whether each block needs the memory of an observer.
    pub(super) fn observe(&self) -> bool {
        self.observer.is_some()
    }

    /// The estimate at the start of a trajectory. As on a real Qube, the estimator takes the
    /// velocities at the first measurement to be 0. With true states, the estimate is the true
    /// state.
    pub(super) fn first(&self, state: &State<f32>) -> State<f32> {
        match self.guard {
            None => *state,
            Some(_) => State {
                theta: self.theta.quantised(state.theta),
                alpha: self.alpha.quantised(state.alpha),
                theta_dot: 0.0,
                alpha_dot: 0.0,
            },
        }
    }

    /// Advances the states that policy and guard see by one sample. `observers` is the memory of
    /// the block's observers, if the policy has observers. `voltages_v` are the commands of the
    /// elapsed period, V.
    #[inline(always)]
    pub(super) fn update(
        &self,
        state: &State<Lanes>,
        lanes: &mut SeenLanes,
        observers: Option<&mut ObserverLanes>,
        voltages_v: &Lanes,
    ) {
        let Some(guard) = &self.guard else {
            // The lanes are copied one by one, because the copy of a whole structure is a function
            // call that costs a few percent of a step.
            for lane in 0..BLOCK {
                let one = state.lane(lane);
                lanes.seen.set_lane(lane, &one);
                lanes.guarded.set_lane(lane, &one);
            }
            return;
        };
        self.filter(&mut lanes.guarded, state, guard);
        match (&self.observer, observers, &self.slow) {
            (Some(observer), Some(memory), _) => {
                lanes.seen = observer.update(memory, voltages_v, &lanes.guarded);
            }
            (_, _, Some(slow)) => self.filter(&mut lanes.seen, state, slow),
            _ => lanes.seen = lanes.guarded,
        }
    }

    #[inline(always)]
    fn filter(&self, seen: &mut State<Lanes>, state: &State<Lanes>, gains: &FilterGains<f32>) {
        let Self { theta, alpha, .. } = *self;
        for lane in 0..BLOCK {
            let theta = theta.quantised(state.theta[lane]);
            let alpha = alpha.quantised(state.alpha[lane]);
            let now = through_filters(&seen.lane(lane), theta, alpha, gains);
            seen.set_lane(lane, &now);
        }
    }
}
