#![allow(
    clippy::needless_range_loop,
    reason = "a lane indexes many arrays at once, and plain index loops become vector code"
)]

use crate::estimation::{
    KalmanGains, ObserverEquations, ObserverSettings, SentVoltages, prediction_steps,
};
use crate::qube::{
    BLOCK, CONTROL_PERIOD_S, Encoders, InLanes, Lanes, PlantModel, State, limited_to,
};

/// Number of last commands that are remembered; they cover the longest delay of an observer, 0.1 s.
const REMEMBERED: usize = 12;

/// Largest number of pieces of constant voltage in a prediction.
const MAX_PIECES: usize = REMEMBERED;

/// The observer of [`crate::estimation`], computed for the lanes of a simulation. The control
/// period is fixed, so the command that acts at a given time within the period is equally old in
/// every period.
#[derive(Clone, Copy, Debug)]
pub(super) struct LaneObserver {
    equations: ObserverEquations<f32>,
    theta_gains: KalmanGains<f32>,
    alpha_gains: KalmanGains<f32>,
    /// Pieces of constant voltage from the last sample to the current one.
    since: Pieces,
    /// Pieces of constant voltage from the current sample to the instant at which the next command
    /// acts.
    ahead: Pieces,
    /// Largest voltage of the plant, V.
    largest_v: f32,
}

#[derive(Clone, Copy, Debug, Default)]
struct Pieces {
    pieces: [LanePiece; MAX_PIECES],
    count: usize,
}

/// Integration steps under one command.
#[derive(Clone, Copy, Debug, Default)]
struct LanePiece {
    /// Age of the command in periods; 0 is the newest.
    age: usize,
    steps: u64,
    step_s: f32,
}

/// Memory of the observers of a block.
#[derive(Clone, Debug)]
pub(super) struct ObserverLanes {
    /// State at the instant of the last sample.
    estimate: State<Lanes>,
    /// Last commands, V, newest first.
    commands_v: [Lanes; REMEMBERED],
}

impl ObserverLanes {
    /// Observers of Qubes that hang at rest and to which no voltage was sent.
    pub(super) const HANGING: Self = Self {
        estimate: State {
            theta: [0.0; BLOCK],
            alpha: [0.0; BLOCK],
            theta_dot: [0.0; BLOCK],
            alpha_dot: [0.0; BLOCK],
        },
        commands_v: [[0.0; BLOCK]; REMEMBERED],
    };

    /// Restarts a lane with this estimate of a new Qube's state and without past commands.
    pub(super) fn restart(&mut self, lane: usize, estimate: &State<f32>) {
        self.estimate.set_lane(lane, estimate);
        for command_v in &mut self.commands_v {
            command_v[lane] = 0.0;
        }
    }
}

impl LaneObserver {
    pub(super) fn new(settings: &ObserverSettings, plant: &PlantModel) -> Self {
        const PERIOD_US: u64 = (CONTROL_PERIOD_S * 1e6) as u64;
        // A long sequence of commands whose "voltages" are their numbers: the number of the command
        // that acts at a given time shows the command's age.
        let newest = REMEMBERED as u64;
        let mut sent = SentVoltages::new(settings.model.nonidealities.command_delay_s, 0);
        for command in 0..=newest {
            sent.send(command * PERIOD_US, command);
        }
        let pieces = |from_us: u64, until_us: u64| {
            let mut pieces = Pieces::default();
            for piece in sent.between(from_us, until_us).take(MAX_PIECES) {
                let (steps, step_s) = prediction_steps(piece.duration_us);
                let age = (newest - piece.voltage) as usize;
                pieces.pieces[pieces.count] = LanePiece { age, steps, step_s: step_s as f32 };
                pieces.count += 1;
            }
            pieces
        };
        let (before_us, now_us) = (newest * PERIOD_US, (newest + 1) * PERIOD_US);
        let gains = |encoder, noise_rad_s2| {
            KalmanGains::steady_state(encoder, noise_rad_s2, CONTROL_PERIOD_S).cast()
        };
        let Encoders { theta, alpha } = plant.encoders;
        Self {
            equations: ObserverEquations::new(settings),
            theta_gains: gains(theta, settings.theta_noise_rad_s2),
            alpha_gains: gains(alpha, settings.alpha_noise_rad_s2),
            largest_v: plant.limits.largest_voltage_v as f32,
            since: pieces(before_us, now_us),
            ahead: pieces(now_us, now_us + sent.delay_us()),
        }
    }

    /// Advances the observers by one sample. `voltages_v` are the commands of the elapsed period,
    /// V; `filtered` are the states of the guard's filter at the sample. Returns the estimated
    /// states at the instant at which the next commands will act.
    #[inline(always)]
    pub(super) fn update(
        &self,
        lanes: &mut ObserverLanes,
        voltages_v: &Lanes,
        filtered: &State<Lanes>,
    ) -> State<Lanes> {
        let ObserverLanes { estimate, commands_v } = lanes;
        commands_v.rotate_right(1);
        let largest_v = self.largest_v;
        for lane in 0..BLOCK {
            commands_v[0][lane] = limited_to(voltages_v[lane], largest_v);
        }
        self.predict(&self.since, estimate, commands_v);
        for lane in 0..BLOCK {
            let (corrected, _) = self.equations.correct(
                &estimate.lane(lane),
                &filtered.lane(lane),
                &self.theta_gains,
                &self.alpha_gains,
            );
            estimate.set_lane(lane, &corrected);
        }
        let mut shown = *estimate;
        self.predict(&self.ahead, &mut shown, commands_v);
        for lane in 0..BLOCK {
            let own = ObserverEquations::shown(&shown.lane(lane), &filtered.lane(lane));
            shown.set_lane(lane, &own);
        }
        shown
    }

    #[inline(always)]
    fn predict(
        &self,
        pieces: &Pieces,
        states: &mut State<Lanes>,
        commands_v: &[Lanes; REMEMBERED],
    ) {
        for piece in pieces.pieces.iter().take(pieces.count) {
            let voltages_v = &commands_v[piece.age.min(REMEMBERED - 1)];
            for _ in 0..piece.steps {
                for lane in 0..BLOCK {
                    let next =
                        self.equations.predict(states.lane(lane), voltages_v[lane], piece.step_s);
                    states.set_lane(lane, &next);
                }
            }
        }
    }
}
