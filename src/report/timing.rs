use super::chart::{Axis, Chart, Series, Style};
use super::page::{Cell, Page};
use crate::scoring::Latencies;
use crate::telemetry::LatencySummary;

/// Bars per decade of the histogram.
const PER_DECADE: i32 = 6;

/// Adds the timing of all ticks: missed deadlines, percentiles, and, unless no tick was late, a
/// histogram of the lateness. If no tick is recorded, adds only a sentence that says so.
pub fn add_timing(page: &mut Page, latencies: &Latencies) {
    page.section("Timing");
    let (missed, ticks) = (latencies.missed_deadlines(), latencies.ticks());
    if ticks == 0 {
        return page.paragraph("No tick is recorded so far.");
    }
    page.paragraph(&format!(
        "{ticks} ticks of 10 ms each; missed deadlines: {missed} (ticks that were skipped, late by more than a \
         period, or without a valid sample)."
    ));
    let row = |name: &str, summary: LatencySummary| {
        let number = |value: f64| Cell::number(Some(value), 0);
        vec![
            name.into(),
            number(summary.p50),
            number(summary.p99),
            number(summary.p999),
            number(summary.max),
        ]
    };
    let lateness_us = latencies.lateness_us();
    page.table(
        &["µs", "median", "99 %", "99.9 %", "largest"],
        &[
            row("lateness of the wake-up", lateness_us),
            row("from sample to act, by the board's clock", latencies.sample_to_act_us()),
        ],
        None,
    );
    if lateness_us.max <= 0.0 {
        page.paragraph("These rollouts ran in virtual time, in which no tick is late.");
        return;
    }
    let edges: Vec<f64> = (0..=5 * PER_DECADE)
        .map(|step| 10_f64.powf(f64::from(step) / f64::from(PER_DECADE)))
        .collect();
    let counts = latencies.lateness_counts(&edges);
    let half = 10_f64.powf(0.5 / f64::from(PER_DECADE));
    // Lateness up to the first edge counts in the first bar.
    let bars: Vec<(f64, u64)> = edges.iter().map(|edge| edge / half).zip(counts).collect();
    let used = |bars: &[(f64, u64)]| bars.iter().position(|(_, count)| *count > 0);
    let first = used(&bars).unwrap_or(0);
    let from_end = bars.iter().rev().position(|(_, count)| *count > 0).unwrap_or(0);
    let bars = &bars[first..bars.len() - from_end];
    let chart = Chart {
        x: Axis::new("lateness of the wake-up", "µs"),
        y: Axis::new("ticks", ""),
        xs: bars.iter().map(|(at, _)| *at).collect(),
        series: vec![Series::new(
            "ticks",
            Style::Bars,
            0,
            bars.iter().map(|(_, count)| (*count > 0).then_some(*count as f64)),
        )],
        logarithmic: true,
        y_logarithmic: true,
        // A single tick must show as a bar, too, on the logarithmic axis.
        y_range: Some([0.5, (2.0 * latencies.ticks() as f64).max(10.0)]),
        ..Chart::default()
    };
    page.chart(
        "Lateness of the control loop's wake-ups",
        "Each bar is a sixth of a decade wide; both axes are logarithmic, so that a single late tick shows.",
        chart,
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::TickRecord;

    #[test]
    fn virtual_time_is_mentioned_only_if_ticks_are_recorded() {
        let told = |ticks: &[TickRecord]| {
            let mut latencies = Latencies::default();
            latencies.add(ticks);
            let mut page = Page::new("timing");
            add_timing(&mut page, &latencies);
            page.finish().unwrap()
        };
        let none = told(&[]);
        assert!(none.contains("No tick is recorded so far.") && !none.contains("virtual time"));
        assert!(told(&[TickRecord::default()]).contains("ran in virtual time"));
        let late = TickRecord { lateness_ns: 5_000, ..TickRecord::default() };
        assert!(!told(&[late]).contains("virtual time"));
    }
}
