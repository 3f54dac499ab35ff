//! The guard of simulated Qubes, which works as on a real one.

use qube_hil::estimation::{FilterGains, GUARD_CORNER_RAD_S, through_filters};
use qube_hil::qube::{CONTROL_PERIOD_S, MAX_HISTORY, PlantModel, State};
use qube_hil::safety::{Brake, ForesightSettings, TrustedForesight, clamp_to_mv};
use qube_hil::simulation::{SensorModel, SimulationSettings};

/// Foresight for many Qubes of a known plant. It does not have the parameters of a single Qube.
///
/// It gets the state through a filter, as the guard of a real Qube does, and through encoders where
/// the simulation has them. It simulates the brake before each voltage. It replaces a voltage after
/// which the brake would come too late by the brake's voltage.
pub struct Guard {
    plant: PlantModel,
    foresight: TrustedForesight,
    /// Filter that estimates velocities from the true angles, because foresight expects velocities
    /// with the lag of a filter; `None` with encoders, whose simulation has the guard's filter.
    filter: Option<FilterGains>,
    lanes: Vec<Guarded>,
}

/// The guard's memory of one Qube.
#[derive(Clone)]
struct Guarded {
    state: State,
    /// Last voltages sent, newest first, V.
    sent_v: [f32; MAX_HISTORY],
    took_over: bool,
}

impl Guard {
    /// A guard of this many Qubes.
    pub fn new(lanes: usize, settings: &SimulationSettings) -> Self {
        let plant = &settings.plant;
        let filters = settings.sensors == SensorModel::TrueState;
        let idle =
            Guarded { state: State::default(), sent_v: [0.0; MAX_HISTORY], took_over: false };
        Self {
            plant: *plant,
            foresight: ForesightSettings::of_plant(plant).foresight(None, plant),
            filter: filters.then(|| FilterGains::new(GUARD_CORNER_RAD_S, CONTROL_PERIOD_S)),
            lanes: vec![idle; lanes],
        }
    }

    /// Begins an episode of the Qube in this lane. `guarded` has the angles that the simulation
    /// shows to the guard, rad; the velocities count as 0.
    pub fn begin(&mut self, lane: usize, guarded: State<f32>) {
        let state = State { theta_dot: 0.0, alpha_dot: 0.0, ..State::from(guarded) };
        self.lanes[lane] = Guarded { state, sent_v: [0.0; MAX_HISTORY], took_over: false };
    }

    /// The voltage that the Qube in this lane gets, V: `wanted_v`, or the brake's voltage where the
    /// guard takes over.
    pub fn permitted_v(&mut self, lane: usize, wanted_v: f32) -> f32 {
        let Self { plant, foresight, lanes, .. } = self;
        let guarded = &mut lanes[lane];
        let largest_v = plant.limits.largest_voltage_v;
        let in_volts = |wanted_v: f64| {
            clamp_to_mv(wanted_v, largest_v).map_or(0.0, |voltage_mv| f32::from(voltage_mv) * 1e-3)
        };
        let mut voltage_v = in_volts(wanted_v.into());
        let too_late =
            foresight.too_late_for(&guarded.state.cast(), &guarded.sent_v, voltage_v).is_some();
        if too_late {
            guarded.took_over = true;
            voltage_v = in_volts(Brake::centring(plant).voltage_v(&guarded.state));
        }
        guarded.sent_v.rotate_right(1);
        guarded.sent_v[0] = voltage_v;
        // A simulation without the guard does not round voltages, so a permitted voltage is not
        // rounded either.
        if too_late { voltage_v } else { wanted_v }
    }

    /// Updates the estimated state after a control period. `guarded` is the state that the
    /// simulation shows to the guard, rad and rad/s.
    pub fn observe(&mut self, lane: usize, guarded: State<f32>) {
        let state = &mut self.lanes[lane].state;
        let guarded: State = guarded.into();
        *state = match &self.filter {
            Some(filter) => through_filters(state, guarded.theta, guarded.alpha, filter),
            None => guarded,
        };
    }

    /// Returns whether the guard took over from the policy in this episode.
    pub fn took_over(&self, lane: usize) -> bool {
        self.lanes[lane].took_over
    }
}
