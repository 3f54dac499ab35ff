use super::foresight::Prediction;
use super::{CentringBrake, Foresight, Outlook};
use crate::qube::{MAX_HISTORY, State};

/// Looks ahead with what is believed of an identified Qube for as long as the Qube moves as that says, and
/// with what any Qube may be otherwise.
///
/// A profile earns its trust anew in each rollout: the arm settles as any Qube's, and if the particles of
/// the profile predict all of that the policy runs under them. One motion that none of them predicts
/// ends the trust.
#[derive(Clone, Debug)]
pub struct TrustedForesight {
    any: Foresight<CentringBrake>,
    identified: Option<Identified>,
}

#[derive(Clone, Debug)]
struct Identified {
    foresight: Foresight<CentringBrake>,
    prediction: Prediction,
    trust: Trust,
}

/// How far what is believed of an identified Qube is trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Trust {
    /// It has predicted everything so far.
    Untested,
    /// It decides.
    Earned,
    /// Something moved as it does not say.
    Lost,
}

/// What a sample says of the trust in a profile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trial {
    /// Nothing has changed.
    Passed,
    /// The Qube has just moved as no particle of the profile that decides may.
    Failed,
}

impl TrustedForesight {
    /// For any Qube, and for the identified one where it is.
    #[must_use]
    pub fn new(
        any: Foresight<CentringBrake>,
        identified: Option<Foresight<CentringBrake>>,
    ) -> Self {
        let identified = identified.map(|foresight| {
            let prediction = Prediction::of(&foresight);
            Identified { foresight, prediction, trust: Trust::Untested }
        });
        Self { any, identified }
    }

    /// Takes the estimated state of a sample, its time by the device's clock, and the commands before it (V, newest
    /// first).
    #[must_use]
    pub fn follow(
        &mut self,
        state: &State,
        device_time_us: u64,
        sent_v: &[f32; MAX_HISTORY],
    ) -> Trial {
        let Some(Identified { prediction, trust, .. }) = &mut self.identified else {
            return Trial::Passed;
        };
        if *trust == Trust::Lost || prediction.is_kept(state, device_time_us, sent_v) {
            return Trial::Passed;
        }
        let decided = *trust == Trust::Earned;
        *trust = Trust::Lost;
        if decided { Trial::Failed } else { Trial::Passed }
    }

    /// The policy gets the motor: from now on what is believed of the identified Qube decides, if it has
    /// predicted how the arm settled. Angles may be counted from another zero.
    pub fn begin_policy(&mut self) {
        if let Some(Identified { prediction, trust, .. }) = &mut self.identified {
            prediction.begin_anew();
            if *trust == Trust::Untested {
                *trust = Trust::Earned;
            }
        }
    }

    /// What comes of this voltage, as [`Foresight::look`] says.
    #[must_use]
    pub fn look(
        &mut self,
        state: &State<f32>,
        sent_v: &[f32; MAX_HISTORY],
        voltage_v: f32,
    ) -> Outlook {
        match &mut self.identified {
            Some(Identified { foresight, trust: Trust::Earned, .. }) => {
                foresight.look(state, sent_v, voltage_v)
            }
            _ => self.any.look(state, sent_v, voltage_v),
        }
    }
}
