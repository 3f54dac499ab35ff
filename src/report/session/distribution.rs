//! The section about the distribution of simulations in which the session's best policy was
//! trained, beside the nominal Qube.

use thiserror::Error;

use super::SessionSource;
use crate::qube::{DomainParameter, Quantity, QubeModel};
use crate::report::densities::{density_chart, words};
use crate::report::draws::{DRAWS_IN_WORDS, QuantityDraws};
use crate::report::page::{Cell, Page};
use crate::session::{ScoredCandidate, SessionSettings};
use crate::simulation::{DomainDistribution, Model, PsiError};

/// Adds the distribution in which the best verified policy was trained or, before a verification,
/// the policy of the searched candidate with the best mean return so far; adds nothing without
/// either.
pub(super) fn add_distribution(page: &mut Page, source: &SessionSource) {
    let verified = ScoredCandidate::best_verified(&source.candidates);
    let searched = || source.candidates.iter().filter(|it| it.candidate.purpose.is_searched());
    let best_so_far = || {
        let with_mean = searched().filter_map(|it| Some((it.mean_return()?, it)));
        with_mean.max_by(|one, other| one.0.total_cmp(&other.0)).map(|(_, it)| it)
    };
    let Some(chosen) = verified.map(|index| &source.candidates[index]).or_else(best_so_far) else {
        return;
    };
    let trained_as = source.trained_as(&chosen.candidate);
    page.section("The distribution of simulations");
    let TrainedIn { distribution, model, search } = match trained_in(source, chosen, trained_as) {
        Ok(trained_in) => trained_in,
        Err(reason) => return page.paragraph(&format!("It is unknown: {reason}.")),
    };
    let whose =
        if verified.is_some() { "the best verified policy" } else { "the best policy so far" };
    page.paragraph(&format!(
        "{whose} is from candidate {trained_as}. In its training, each simulated Qube draws its properties from \
         these distributions. The curves are smoothed from {DRAWS_IN_WORDS} such draws; the dashed vertical line marks the \
         nominal Qube, as its maker describes it.",
        whose = crate::report::rollout::first_upper(whose)
    ));
    if search.is_none() {
        page.paragraph(&format!(
            "This policy was trained in the distribution {model}, not around the identified Qube, and has no psi: if \
             the identification has doubts, such a policy competes with the policies around the identified Qube, and \
             the best in simulations is kept."
        ));
    }
    let directions = distribution.directions().len();
    if directions > 0 {
        page.paragraph(&format!(
            "The draws are correlated: {directions} joint deviations, the errors of the fit, move several properties at \
             once. A value that they would move out of its range is put at the end of the range. Each curve shows one \
             property for all values of the others."
        ));
    }
    let nominal = source.settings.plant().nominal();
    let base = search.as_ref().and_then(|settings| settings.base_distribution().ok());
    let drawn = QuantityDraws::of(&distribution);
    add_densities(page, &distribution, base.as_ref(), &drawn, &nominal);
    add_numbers(page, &drawn, &nominal);
    if let Some(settings) = search {
        add_psi(page, &settings, &chosen.candidate.point);
    }
}

/// All quantities in the order of the section: masses and lengths first.
fn in_order() -> Vec<Quantity> {
    let first = DomainParameter::MASSES_AND_LENGTHS.map(Quantity::Parameter);
    let others = Quantity::all().filter(|quantity| !first.contains(quantity));
    first.into_iter().chain(others).collect()
}

/// Adds a chart of each quantity that is spread: its draws `drawn` from `distribution` and, where
/// they differ, its draws from `base`, the distribution before the search.
fn add_densities(
    page: &mut Page,
    distribution: &DomainDistribution,
    base: Option<&DomainDistribution>,
    drawn: &[QuantityDraws],
    nominal: &QubeModel,
) {
    let before = base.map(QuantityDraws::of);
    page.grid(|page| {
        for quantity in in_order() {
            let drawn = &drawn[quantity.index()];
            if drawn.has_spread() {
                let differs = base
                    .is_some_and(|base| base.marginal(quantity) != distribution.marginal(quantity));
                let before = before.as_ref().filter(|_| differs);
                let mut curves = vec![("in its training", drawn)];
                curves.extend(before.map(|it| ("before the search", &it[quantity.index()])));
                let caption = crate::report::rollout::first_upper(&words(quantity));
                let chart = density_chart(quantity, &curves, nominal.get(quantity));
                page.chart(&caption, "", chart);
            }
        }
    });
}

/// Adds a table of all quantities: the nominal values beside the draws.
fn add_numbers(page: &mut Page, drawn: &[QuantityDraws], nominal: &QubeModel) {
    page.details("All quantities as numbers", |page| {
        let rows: Vec<Vec<Cell>> = in_order()
            .into_iter()
            .map(|quantity| {
                let drawn = &drawn[quantity.index()];
                let value = nominal.get(quantity);
                let ratio = (value != 0.0).then(|| drawn.mean / value);
                vec![
                    words(quantity).into(),
                    Cell::significant(value),
                    Cell::significant(drawn.mean),
                    Cell::significant(drawn.standard_deviation),
                    Cell::number(ratio, 3),
                    quantity.unit().into(),
                ]
            })
            .collect();
        let heads = [
            "quantity",
            "nominal",
            "mean of the draws",
            "standard deviation of the draws",
            "mean / nominal",
            "unit",
        ];
        page.table(&heads, &rows, None);
    });
}

/// The distribution in which a policy was trained.
struct TrainedIn {
    distribution: DomainDistribution,
    /// Name of its model.
    model: &'static str,
    /// Settings of the search that chose its psi; `None` for a policy without psi.
    search: Option<SessionSettings>,
}

/// The reason why the distribution in which a policy was trained is unknown.
#[derive(Debug, Error)]
enum UnknownDistribution {
    #[error("no model has the name {0}")]
    NoSuchModel(String),
    #[error(
        "it lies around a profile that the session identified, and this profile cannot be read"
    )]
    ProfileLost,
    #[error(transparent)]
    Psi(#[from] PsiError),
}

/// Finds the distribution in which the policy of this candidate was trained: for a policy without
/// psi from the model that its file names, otherwise from the settings of the search at the
/// proposal of candidate `trained_as`, whose training made the policy.
///
/// # Errors
/// The distribution is unknown.
fn trained_in(
    source: &SessionSource,
    chosen: &ScoredCandidate,
    trained_as: u32,
) -> Result<TrainedIn, UnknownDistribution> {
    let began = &source.settings;
    if let Some(name) = &chosen.model_without_psi {
        let model = Model::ALL.into_iter().find(|model| model.name() == name);
        let model = model.ok_or_else(|| UnknownDistribution::NoSuchModel(name.clone()))?;
        let distribution = model.distribution(began.plant(), began.family, None, None)?;
        return Ok(TrainedIn { distribution, model: model.name(), search: None });
    }
    let settings =
        source.search_settings(Some(trained_as)).ok_or(UnknownDistribution::ProfileLost)?;
    let psi = settings.psi.psi(&chosen.candidate.point)?;
    let distribution = settings.distribution(&psi)?;
    Ok(TrainedIn { distribution, model: settings.model.name(), search: Some(settings) })
}

/// Adds the entries of the chosen psi with units and ranges.
fn add_psi(page: &mut Page, settings: &SessionSettings, point: &[f64]) {
    page.details("Psi, which shapes the distribution", |page| {
        let rows: Vec<Vec<Cell>> = settings
            .psi
            .dimensions()
            .iter()
            .zip(point)
            .map(|(dimension, value)| {
                vec![
                    dimension.target.to_string().into(),
                    Cell::significant(*value),
                    Cell::significant(dimension.lower),
                    Cell::significant(dimension.upper),
                    dimension.target.unit().into(),
                ]
            })
            .collect();
        page.table(&["entry", "value", "from", "to", "unit"], &rows, None);
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qube::Profile;
    use crate::scoring::{Quietness, Verdict};
    use crate::session::{
        Candidate, Entry, IdentificationSettings, Purpose, ScoredRollout, SessionPaths,
        SessionState,
    };
    use crate::storage::MachineDisk;

    /// The section about a session whose first searched candidate, number 1, has the best policy.
    fn section(source: &SessionSource) -> String {
        let mut page = Page::new("a session");
        add_distribution(&mut page, source);
        page.finish().unwrap()
    }

    #[test]
    fn the_section_mentions_a_policy_without_psi_and_a_lost_profile() {
        let folder = tempfile::tempdir().unwrap();
        let plan = IdentificationSettings::default();
        let settings = SessionSettings { identification: Some(plan), ..SessionSettings::quick() };
        let path = SessionPaths::new(folder.path()).configuration();
        std::fs::write(path, settings.to_toml().unwrap()).unwrap();
        let mut source = SessionSource::read(&MachineDisk, folder.path()).unwrap();
        let (verdict, missing_effects, checksum) = ("fits_but".into(), Vec::new(), String::new());
        let found = Entry::Identified { recordings: 1, verdict, missing_effects, checksum };
        source.state = SessionState::of(&[found]).unwrap();
        source.profiles = vec![(1, Profile::lab())];
        let candidate = Candidate {
            number: 1,
            purpose: Purpose::Initial,
            point: source.search_settings(None).unwrap().psi.as_identified(),
            trained: true,
            policy_checksum: None,
            finished: Vec::new(),
            void: 0,
            void_before: 0,
            policy_of: None,
            identified_from: None,
        };
        let outcome = crate::recording::samples::outcome();
        let rollout = ScoredRollout {
            verdict: Verdict::Result { return_: 500.0, success: true, outcome },
            quietness: Quietness::NONE,
            model_without_psi: None,
        };
        source.candidates = vec![ScoredCandidate::new(candidate, [rollout])];

        let around = section(&source);
        assert!(around.contains("Psi, which shapes the distribution"), "{around}");
        assert!(!around.contains("has no psi"), "{around}");

        source.candidates[0].model_without_psi = Some("robust".into());
        let robust = section(&source);
        assert!(robust.contains("in the distribution robust, not around the identified Qube"));
        assert!(!robust.contains("Psi, which shapes the distribution"));

        source.candidates[0].model_without_psi = None;
        source.profiles.clear();
        let lost = section(&source);
        assert!(lost.contains("this profile cannot be read"), "{lost}");
        assert!(!lost.contains("each simulated Qube draws"), "{lost}");
    }
}
