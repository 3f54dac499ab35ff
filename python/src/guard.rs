//! The guard beside simulated Qubes, as on a machine.

use qube_hil::estimation::{FilterGains, GUARD_CORNER_RAD_S, through_filters};
use qube_hil::qube::{CONTROL_PERIOD_S, MAX_HISTORY, PlantModel, State};
use qube_hil::safety::{Brake, ForesightSettings, TrustedForesight, clamp_to_mv};

/// Foresight for many Qubes of which nothing is known but their plant.
///
/// It estimates velocities from the angles that the sensors show, by its own filter, and simulates the brake before each
/// voltage. A voltage after which the brake would come too late is replaced by the brake's own.
pub struct Guard {
    plant: PlantModel,
    foresight: TrustedForesight,
    filter: FilterGains,
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
    pub fn new(lanes: usize, plant: &PlantModel) -> Self {
        let idle =
            Guarded { state: State::default(), sent_v: [0.0; MAX_HISTORY], took_over: false };
        Self {
            plant: *plant,
            foresight: ForesightSettings::of_plant(plant).foresight(None, plant),
            filter: FilterGains::new(GUARD_CORNER_RAD_S, CONTROL_PERIOD_S),
            lanes: vec![idle; lanes],
        }
    }

    /// Begins an episode of a Qube that is seen so.
    pub fn begin(&mut self, lane: usize, seen: State<f32>) {
        let State { theta, alpha, .. } = seen;
        let state = State { theta: theta.into(), alpha: alpha.into(), ..State::default() };
        self.lanes[lane] = Guarded { state, sent_v: [0.0; MAX_HISTORY], took_over: false };
    }

    /// The voltage that a Qube gets for this one: the same, or the brake's where the guard takes over.
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
        // Without the guard the simulation has unrounded voltages, which a permitted action keeps.
        if too_late { voltage_v } else { wanted_v }
    }

    /// Takes the angles after a control period.
    pub fn observe(&mut self, lane: usize, seen: State<f32>) {
        let state = &mut self.lanes[lane].state;
        *state = through_filters(state, seen.theta.into(), seen.alpha.into(), &self.filter);
    }

    /// Whether the guard took over in this episode.
    pub fn took_over(&self, lane: usize) -> bool {
        self.lanes[lane].took_over
    }
}
