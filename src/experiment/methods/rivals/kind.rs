use super::adr::ActiveRandomisation;
use super::bayessim::BayesSim;
use super::dropo::Dropo;
use super::epopt::EpOpt;
use super::fpo::FingerprintOptimisation;
use super::history::LongHistory;
use super::lsdr::Lsdr;
use super::npdr::Npdr;
use super::rival::{Data, Rival};
use super::settings::RivalSettings;
use super::simopt::SimOpt;

/// A method from the literature, chosen by its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RivalKind {
    /// Moves the distribution of simulations so that the policy's simulated trajectories resemble
    /// its real ones; the divergence of each step is bounded (Chebotar et al., reference 10 of the
    /// thesis).
    SimOpt,
    /// Learns the posterior of the Qube given summary statistics of trajectories, by a mixture
    /// density network (Ramos et al., reference 17).
    BayesSim,
    /// Finds the distribution under which recorded transitions are most likely (Tiboni et al.
    /// 2023).
    Dropo,
    /// Trains on the worst trajectories and weights Qubes by the likelihood of real transitions
    /// (Rajeswaran et al., reference 18).
    EpOpt,
    /// Learns the posterior of the Qube given rollouts, round by round
    /// (Muratore et al., CoRL 2021).
    Npdr,
    /// Widens the distribution as far as the policy earns a high return in it, without real
    /// rollouts (Mozifian et al., reference 11).
    Lsdr,
    /// Chooses the distribution of each part of a training by Bayesian optimisation (Paul et al.,
    /// reference 21).
    Fpo,
    /// Trains on Qubes in which the policy behaves unlike its behaviour in the mean Qube of the
    /// prior (Mehta et al., reference 20).
    Adr,
    /// Trains one policy that observes the longest history of its commands, to tell Qubes apart
    /// while it acts.
    History,
}

impl RivalKind {
    /// Every rival.
    pub const ALL: [Self; 9] = [
        Self::SimOpt,
        Self::BayesSim,
        Self::Dropo,
        Self::EpOpt,
        Self::Npdr,
        Self::Lsdr,
        Self::Fpo,
        Self::Adr,
        Self::History,
    ];

    /// The rival's name in settings, folders and tables.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::SimOpt => "simopt",
            Self::BayesSim => "bayessim",
            Self::Dropo => "dropo",
            Self::EpOpt => "epopt",
            Self::Npdr => "npdr",
            Self::Lsdr => "lsdr",
            Self::Fpo => "fpo",
            Self::Adr => "adr",
            Self::History => "history",
        }
    }

    /// Returns whether the rival takes no real rollout.
    #[must_use]
    pub fn needs_no_rollouts(self) -> bool {
        self.rival(&RivalSettings::default()).data() == Data::None
    }

    pub(super) fn rival(self, settings: &RivalSettings) -> Box<dyn Rival> {
        match self {
            Self::SimOpt => Box::new(SimOpt { divergence: settings.simopt_divergence }),
            Self::BayesSim => {
                Box::new(BayesSim { components: settings.bayessim_components as usize })
            }
            Self::Dropo => Box::new(Dropo::with_noise(settings.dropo_noise)),
            Self::EpOpt => Box::new(EpOpt { worst_share: settings.epopt_worst_share as f32 }),
            Self::Npdr => Box::new(Npdr { widening: settings.npdr_widening }),
            Self::Lsdr => Box::new(Lsdr { weight: settings.lsdr_weight }),
            Self::Fpo => Box::new(FingerprintOptimisation { beta: settings.fpo_beta }),
            Self::Adr => Box::new(ActiveRandomisation { temperature: settings.adr_temperature }),
            Self::History => Box::new(LongHistory),
        }
    }
}
