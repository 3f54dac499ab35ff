use std::fmt::Write;
use std::path::Path;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::Serialize;
use sha2::{Digest, Sha256};

use super::chart::{Chart, Map};
use super::draws::NEGLIGIBLE;
use super::escape::{escaped, inert};
use super::motion::PackedMotion;
use crate::storage::Disk;

/// uPlot 1.6.32 by Leon Sorokin, MIT; its licence is beside it.
const PLOTS: &str = include_str!("assets/uPlot.iife.min.js");
const PLOTS_STYLE: &str = include_str!("assets/uPlot.min.css");
const SCRIPT: &str = include_str!("assets/report.js");
const STYLE: &str = include_str!("assets/report.css");

/// The beginning of every report, up to the hashes of its scripts; [`is_report`] recognises a
/// report by it.
const BEGINNING: &str = "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
    <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; script-src ";

/// Returns whether the file at this path is a report of this version or an earlier version of the
/// program.
#[must_use]
pub fn is_report(disk: &dyn Disk, path: &Path) -> bool {
    let length = BEGINNING.len();
    let beginning = disk.read_beginning(path, length as u64);
    beginning.is_ok_and(|bytes| bytes == BEGINNING.as_bytes())
}

/// An HTML page that is being written, with the data of its figures. It escapes every text that its
/// methods get, except the SVG of a [`picture`](Self::picture).
#[derive(Debug, Default)]
pub struct Page {
    title: String,
    body: String,
    charts: Vec<Chart>,
    maps: Vec<Map>,
    motions: Vec<PackedMotion>,
    first_motion: usize,
}

/// The data of a page's figures.
#[derive(Serialize)]
struct Data<'a> {
    charts: &'a [Chart],
    maps: &'a [Map],
    motions: &'a [PackedMotion],
    first_motion: usize,
}

/// A cell of a table.
#[derive(Clone, Debug, PartialEq)]
pub enum Cell {
    /// A text, aligned to the left.
    Text(String),
    /// A number with its digits, aligned to the right.
    Number(String),
}

impl Cell {
    /// A number with this many decimals; a dash for `None` and for a number that is not finite.
    pub fn number(value: Option<f64>, decimals: usize) -> Self {
        Self::Number(match value {
            Some(value) if value.is_finite() => format!("{value:.decimals$}"),
            _ => "–".into(),
        })
    }

    /// A number with about four significant digits, as [`significant`] writes it.
    pub fn significant(value: f64) -> Self {
        Self::Number(significant(value))
    }
}

impl From<&str> for Cell {
    fn from(text: &str) -> Self {
        Self::Text(text.into())
    }
}

impl From<String> for Cell {
    fn from(text: String) -> Self {
        Self::Text(text)
    }
}

/// Formats a number with four significant digits, or, from 1e4 to 1e6, as a whole number. Below
/// 1e-4 and from 1e6 on, where zeros would hide the digits, it is written with a power of ten.
/// Magnitudes below [`NEGLIGIBLE`] become 0; a number that is not finite is written as `NaN`, `inf`
/// or `-inf`.
pub fn significant(value: f64) -> String {
    let size = value.abs();
    if size < NEGLIGIBLE {
        return "0".into();
    }
    if !value.is_finite() {
        return format!("{value}");
    }
    if !(1e-4..1e6).contains(&size) {
        return format!("{value:.3e}");
    }
    let decimals = (3 - size.log10().floor() as i32).clamp(0, 8) as usize;
    format!("{value:.decimals$}")
}

impl Page {
    /// A page with this title.
    pub fn new(title: impl Into<String>) -> Self {
        Self { title: title.into(), ..Self::default() }
    }

    /// Adds a sentence about the outcome.
    pub fn outcome(&mut self, text: &str) {
        let _ = writeln!(self.body, "<p class=\"outcome\">{}</p>", escaped(text));
    }

    /// Begins a section.
    pub fn section(&mut self, title: &str) {
        let _ = writeln!(self.body, "<h2>{}</h2>", escaped(title));
    }

    /// Adds a heading within a section.
    pub fn heading(&mut self, title: &str) {
        let _ = writeln!(self.body, "<h3>{}</h3>", escaped(title));
    }

    /// Adds a paragraph.
    pub fn paragraph(&mut self, text: &str) {
        let _ = writeln!(self.body, "<p>{}</p>", escaped(text));
    }

    /// Adds commands, each below a line with its purpose.
    pub fn commands(&mut self, commands: &[(String, String)]) {
        for (purpose, command) in commands {
            let (purpose, command) = (escaped(purpose), escaped(command));
            let _ = writeln!(self.body, "<p class=\"facts\">{purpose}</p>\n<pre>{command}</pre>");
        }
    }

    /// Adds a table. The row with the index `best` is emphasised. Numbers are aligned to the right,
    /// and so is the head of a column that begins with a number.
    pub fn table(&mut self, heads: &[&str], rows: &[Vec<Cell>], best: Option<usize>) {
        let is_number = |column: usize| {
            rows.first().is_some_and(|row| matches!(row.get(column), Some(Cell::Number(_))))
        };
        self.body.push_str("<div class=\"wide\"><table><thead><tr>");
        for (column, head) in heads.iter().enumerate() {
            let class = if is_number(column) { " class=\"n\"" } else { "" };
            let _ = write!(self.body, "<th{class}>{}</th>", escaped(head));
        }
        self.body.push_str("</tr></thead><tbody>\n");
        for (index, row) in rows.iter().enumerate() {
            self.body.push_str(if best == Some(index) { "<tr class=\"best\">" } else { "<tr>" });
            for cell in row {
                let _ = match cell {
                    Cell::Text(text) => {
                        write!(self.body, "<td class=\"text\">{}</td>", escaped(text))
                    }
                    Cell::Number(text) => {
                        write!(self.body, "<td class=\"n\">{}</td>", escaped(text))
                    }
                };
            }
            self.body.push_str("</tr>\n");
        }
        self.body.push_str("</tbody></table></div>\n");
    }

    /// Adds a part that stays folded under `summary` until the reader opens it.
    pub fn details(&mut self, summary: &str, inside: impl FnOnce(&mut Self)) {
        let _ = writeln!(self.body, "<details><summary>{}</summary>", escaped(summary));
        inside(self);
        self.body.push_str("</details>\n");
    }

    /// Lays out the figures that `inside` adds side by side where there is room.
    pub fn grid(&mut self, inside: impl FnOnce(&mut Self)) {
        self.body.push_str("<div class=\"grid\">\n");
        inside(self);
        self.body.push_str("</div>\n");
    }

    /// Adds a figure with a caption and a sentence that explains the figure; an empty sentence is
    /// left out.
    pub fn chart(&mut self, caption: &str, explanation: &str, chart: Chart) {
        let index = self.charts.len();
        self.charts.push(chart);
        self.figure(
            caption,
            explanation,
            &format!(
                "<div class=\"chart\" data-chart=\"{index}\" role=\"img\" aria-label=\"{}\"></div>",
                escaped(caption)
            ),
        );
    }

    /// Adds a map with a caption and a sentence that explains the map.
    pub fn map(&mut self, caption: &str, explanation: &str, map: Map) {
        let index = self.maps.len();
        self.maps.push(map);
        self.figure(caption, explanation, &format!("<canvas class=\"map\" data-map=\"{index}\" role=\"img\" aria-label=\"{}\"></canvas>", escaped(caption)));
    }

    /// Adds a picture, given as an SVG element whose texts are escaped.
    pub fn picture(&mut self, caption: &str, explanation: &str, svg: &str) {
        self.figure(caption, explanation, &format!("<div class=\"wide\">{svg}</div>"));
    }

    fn figure(&mut self, caption: &str, explanation: &str, content: &str) {
        let (caption, explanation) = (escaped(caption), escaped(explanation));
        let small = if explanation.is_empty() {
            String::new()
        } else {
            format!(" <small>{explanation}</small>")
        };
        let _ = writeln!(
            self.body,
            "<figure><figcaption>{caption}{small}</figcaption>{content}</figure>"
        );
    }

    /// Adds the player of these motions; the motion with the index `first` is chosen at the start.
    /// A page has one player.
    pub fn player(&mut self, motions: Vec<PackedMotion>, first: usize) {
        self.first_motion = first.min(motions.len().saturating_sub(1));
        self.motions = motions;
        self.body.push_str("<div class=\"player\" data-player></div>\n");
    }

    /// The whole page as one HTML file that loads nothing.
    ///
    /// # Errors
    /// The data cannot be written as JSON.
    pub fn finish(&self) -> Result<String, serde_json::Error> {
        let data = Data {
            charts: &self.charts,
            maps: &self.maps,
            motions: &self.motions,
            first_motion: self.first_motion,
        };
        let data = inert(&serde_json::to_string(&data)?);
        let title = escaped(&self.title);
        // A browser runs only these two scripts and applies only this style, even if a name in the
        // page contains a script.
        let style = format!("{PLOTS_STYLE}{STYLE}");
        let policy = format!(
            "{} {}; style-src {}; img-src data:; base-uri 'none'; form-action 'none'",
            hash(PLOTS),
            hash(SCRIPT),
            hash(&style)
        );
        Ok(format!(
            "{BEGINNING}{policy}\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
             <meta name=\"referrer\" content=\"no-referrer\">\n\
             <link rel=\"icon\" href=\"data:,\">\n<title>{title}</title>\n<style>{style}</style>\n</head>\n\
             <body>\n<h1>{title}</h1>\n{}\n\
             <noscript><p class=\"script-off\">The figures of this page need JavaScript.</p></noscript>\n\
             <script type=\"application/json\" id=\"data\">{data}</script>\n\
             <script>{PLOTS}</script>\n<script>{SCRIPT}</script>\n</body>\n</html>\n",
            self.body
        ))
    }
}

/// The SHA-256 hash by which a content security policy names a script or a style.
fn hash(text: &str) -> String {
    format!("'sha256-{}'", STANDARD.encode(Sha256::digest(text.as_bytes())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::storage::MachineDisk;

    #[test]
    fn the_hash_of_the_empty_text_is_the_published_value() {
        // The digest of the empty text, as FIPS 180-4 tools print it.
        assert_eq!(hash(""), "'sha256-47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU='");
    }

    #[test]
    fn a_report_is_known_by_its_beginning() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("report.html");
        assert!(!is_report(&MachineDisk, &path));
        std::fs::write(&path, Page::new("a page").finish().unwrap()).unwrap();
        assert!(is_report(&MachineDisk, &path));
        for other in ["", "my own page\n", "<!DOCTYPE html>\n<html lang=\"en\">\n"] {
            std::fs::write(&path, other).unwrap();
            assert!(!is_report(&MachineDisk, &path), "{other}");
        }
    }

    #[test]
    fn hostile_names_stay_names_and_nothing_is_loaded() {
        let hostile = "</script><script>alert(1)</script><img src=x onerror=alert(1)>\"'&";
        let mut page = Page::new(hostile);
        page.outcome(hostile);
        page.section(hostile);
        page.heading(hostile);
        page.paragraph(hostile);
        page.commands(&[(hostile.into(), hostile.into())]);
        page.table(&[hostile], &[vec![hostile.into()]], None);
        page.details(hostile, |page| page.chart(hostile, hostile, Chart::default()));
        let html = page.finish().unwrap();
        assert_eq!(html.matches("<script").count(), 3, "the page has three scripts");
        assert_eq!(html.matches("</script>").count(), 3);
        assert!(!html.contains("<img"));
    }

    #[test]
    fn a_page_loads_nothing() {
        let mut page = Page::new("a page");
        page.chart("a figure", "explained", Chart::default());
        let html = page.finish().unwrap();
        for loading in [
            " src=",
            "@import",
            "url(",
            "<iframe",
            "<object",
            "fetch(",
            "XMLHttpRequest",
            "import(",
        ] {
            assert!(!html.contains(loading), "{loading}");
        }
        // The only address in a page is in the licence notice of uPlot.
        assert_eq!(html.matches("https://").count() + html.matches("http://").count(), 1);
    }

    #[test]
    fn numbers_keep_four_digits() {
        for (value, text) in [
            (0.0, "0"),
            (-8.9e-44, "0"),
            (0.024, "0.02400"),
            (541.23, "541.2"),
            (12_345.6, "12346"),
            (5.3e-8, "5.300e-8"),
        ] {
            assert_eq!(significant(value), text);
        }
    }
}
