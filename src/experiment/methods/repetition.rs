use super::Method;

/// The method of a repetition and its number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RepetitionId {
    /// Method of the comparison.
    pub method: Method,
    /// Number of the repetition, from 0.
    pub number: u32,
}

impl RepetitionId {
    /// Name of the repetition, such as `bayrn 3`.
    #[must_use]
    pub fn name(self) -> String {
        format!("{} {}", self.method, self.number)
    }
}

/// One repetition of a method, with its recommendations so far.
#[derive(Clone, Debug, PartialEq)]
pub struct Repetition {
    /// Method and number.
    pub id: RepetitionId,
    /// Recommendations with their scores, in order. A recommendation that equals an earlier one is
    /// left out.
    pub recommendations: Vec<RecommendationResult>,
    /// True if a recommendation has succeeded or none is left.
    pub is_over: bool,
    /// Largest number of real rollouts that the repetition may take.
    pub budget: u32,
}

/// The result of one recommendation.
#[derive(Clone, Debug, PartialEq)]
pub struct RecommendationResult {
    /// Number of real rollouts before the recommendation; a recording counts as one.
    pub real_rollouts: u32,
    /// Outcome of its scoring.
    pub outcome: RecommendationOutcome,
    /// True if the recommendation succeeds.
    pub succeeds: bool,
}

/// The outcome of scoring a recommendation.
#[derive(Clone, Debug, PartialEq)]
pub enum RecommendationOutcome {
    /// The recommendation's policies were scored.
    Scored(RecommendationScore),
    /// The method has no recommendation, for this reason.
    Refused(String),
}

/// The score of a recommendation, over the rollouts that were run until the decision could not
/// change.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RecommendationScore {
    /// Number of successful rollouts.
    pub balanced: u32,
    /// Number of rollouts run; a rollout whose attempts are all void counts as a failure.
    pub ran: u32,
}

impl RecommendationOutcome {
    /// The reason why there is no recommendation; `None` if it was scored.
    #[must_use]
    pub fn refusal(&self) -> Option<&str> {
        match self {
            Self::Scored(_) => None,
            Self::Refused(reason) => Some(reason),
        }
    }
}

impl Repetition {
    /// Number of real rollouts before the first successful recommendation; `None` without one.
    #[must_use]
    pub fn succeeded_after(&self) -> Option<u32> {
        self.recommendations.iter().find(|it| it.succeeds).map(|it| it.real_rollouts)
    }
}
