//! Tests the pages: every link has a target, every source file that they name exists, every page of
//! `docs` is in the book, and every block of commands or Python runs or states why it does not.

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Component, Path, PathBuf};
use std::process::{Command, Stdio};

use crate::shared::isolate;
use crate::tree::root;

/// Names of folders whose pages, if any, are not tested.
const SKIPPED: [&str; 5] = ["target", ".git", "corpus", "build", "tests"];

/// Languages of fenced blocks that hold commands.
const SHELLS: [&str; 4] = ["sh", "console", "bash", "shell"];

/// Every page of the repository outside the folders [`SKIPPED`], as a path from its root.
pub fn pages() -> Vec<PathBuf> {
    fn collect(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap_or("").to_owned();
            if path.is_dir() && !SKIPPED.contains(&name.as_str()) {
                collect(&path, found);
            } else if name.ends_with(".md") {
                found.push(path.strip_prefix(root()).unwrap().to_owned());
            }
        }
    }
    let mut found = Vec::new();
    collect(root(), &mut found);
    // The sessions in logs/ may hold any pages; only its README belongs to the repository.
    found.retain(|page| !page.starts_with("logs") || page == Path::new("logs/README.md"));
    found.sort();
    found
}

/// A fenced block: its line, the words behind the fence, its text.
struct Block {
    line: usize,
    info: String,
    text: String,
}

/// A page's fenced blocks, and its text without them.
fn parts(page: &Path) -> (Vec<Block>, String) {
    let text = fs::read_to_string(root().join(page)).unwrap();
    let (mut blocks, mut prose, mut open) = (Vec::new(), String::new(), None::<Block>);
    for (number, line) in text.lines().enumerate() {
        match (&mut open, line.trim_start().strip_prefix("```")) {
            (None, Some(info)) => {
                open = Some(Block { line: number + 1, info: info.into(), text: String::new() });
            }
            (Some(_), Some(_)) => blocks.extend(open.take()),
            (Some(block), None) => block.text += &format!("{line}\n"),
            (None, None) => prose += &format!("{line}\n"),
        }
    }
    assert!(open.is_none(), "{}: a block that is not closed", page.display());
    (blocks, prose)
}

/// Targets of the links and pictures of a page that lie in the repository.
fn links(page: &Path) -> Vec<String> {
    let prose = parts(page).1;
    // The text of a link may span two lines, but its target may not.
    let targets = prose.split("](").skip(1).filter_map(|rest| rest.split([')', ' ', '\n']).next());
    targets.filter(|it| !it.contains("://") && !it.starts_with("mailto:")).map(Into::into).collect()
}

/// A path without `.` and `..`.
fn plain(path: &Path) -> PathBuf {
    let mut plain = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir => {
                assert!(plain.pop(), "{} leaves the repository", path.display())
            }
            Component::CurDir => {}
            _ => plain.push(part),
        }
    }
    plain
}

/// The target of a link as a path from the root, and its anchor.
fn target(page: &Path, link: &str) -> (PathBuf, Option<String>) {
    let (file, anchor) =
        link.split_once('#').map_or((link, None), |(file, anchor)| (file, Some(anchor.to_owned())));
    let path = match file {
        "" => page.to_owned(),
        file => plain(&page.parent().unwrap().join(file)),
    };
    (path, anchor)
}

/// The anchors of a page's headings, as GitHub and mdBook make them.
fn anchors(page: &Path) -> BTreeSet<String> {
    let prose = parts(page).1;
    let headings = prose.lines().filter_map(|line| line.strip_prefix('#'));
    headings
        .map(|heading| {
            let heading = heading.trim_start_matches('#').trim().to_lowercase();
            let is_kept = |letter: &char| letter.is_alphanumeric() || " -_".contains(*letter);
            let kept = heading.chars().filter(is_kept);
            kept.map(|letter| if letter == ' ' { '-' } else { letter }).collect()
        })
        .collect()
}

#[test]
fn every_link_leads_to_a_file_and_every_anchor_to_a_heading() {
    let mut lost = Vec::new();
    let mut followed = 0;
    for page in pages() {
        for link in links(&page) {
            let (path, anchor) = target(&page, &link);
            followed += 1;
            let exists = root().join(&path).exists();
            let has_anchor = || anchor.as_ref().is_none_or(|it| anchors(&path).contains(it));
            if !exists || !has_anchor() {
                lost.push(format!("{}: {link}", page.display()));
            }
        }
    }
    assert!(followed > 50, "the links were not found");
    assert!(lost.is_empty(), "links that lead nowhere:\n{}", lost.join("\n"));
}

#[test]
fn the_book_has_every_page_of_docs_and_every_page_that_its_pages_link_to() {
    let summary = Path::new("docs/SUMMARY.md");
    let book: BTreeSet<PathBuf> =
        links(summary).iter().map(|link| target(summary, link).0).collect();
    let is_page = |path: &Path| path.extension().is_some_and(|extension| extension == "md");
    let mut wanted: BTreeSet<PathBuf> =
        pages().into_iter().filter(|page| page.starts_with("docs") && page != summary).collect();
    for page in &book {
        wanted.extend(links(page).iter().map(|it| target(page, it).0).filter(|it| is_page(it)));
    }
    let missing: Vec<_> = wanted.difference(&book).collect();
    assert!(missing.is_empty(), "docs/SUMMARY.md lacks {missing:?}");
}

#[test]
fn every_source_file_that_a_page_names_exists() {
    const FOLDERS: [&str; 7] =
        ["src", "tests", "scripts", "examples", "benches", "firmware-protocol", "profiles"];
    let (mut lost, mut looked_at) = (Vec::new(), 0);
    // The list of changes names files that existed at the time of the change.
    for page in pages().iter().filter(|page| !page.ends_with("CHANGELOG.md")) {
        let prose = parts(page).1;
        let words = prose.split('`').skip(1).step_by(2).flat_map(str::split_whitespace);
        for word in words {
            let is_path = FOLDERS.iter().any(|it| word.starts_with(&format!("{it}/")));
            // ROOM and NNN stand for any name.
            let is_one =
                !word.contains(['*', '<']) && !word.contains("ROOM") && !word.contains("NNN");
            if is_path && is_one {
                looked_at += 1;
                if !root().join(word.trim_end_matches([',', '.', ':', ';'])).exists() {
                    lost.push(format!("{}: {word}", page.display()));
                }
            }
        }
    }
    assert!(looked_at > 50, "the names of files were not found");
    assert!(lost.is_empty(), "files that do not exist:\n{}", lost.join("\n"));
}

/// The commands of a block: the whole text of a script, or the lines after the prompts of a console
/// with their continuation lines.
fn commands(language: &str, text: &str) -> String {
    if language != "console" {
        return text.to_owned();
    }
    let (mut commands, mut goes_on) = (String::new(), false);
    for line in text.lines() {
        let command = if goes_on { Some(line) } else { line.strip_prefix("$ ") };
        if let Some(command) = command {
            commands += &format!("{command}\n");
            goes_on = command.ends_with('\\');
        }
    }
    commands
}

#[test]
fn every_block_of_commands_runs_or_says_why_not() {
    let program = Path::new(env!("CARGO_BIN_EXE_qube-hil")).parent().unwrap();
    let path = format!("{}:{}", program.display(), std::env::var("PATH").unwrap());
    let mut run = 0;
    for page in pages() {
        let folder = tempfile::tempdir().unwrap();
        for shipped in ["plants", "policies", "profiles"] {
            symlink(root().join(shipped), folder.path().join(shipped)).unwrap();
        }
        for Block { line, info, text } in parts(&page).0 {
            let (language, rest) = info.split_once(' ').unwrap_or((&info, ""));
            // `python/tests/test_page.py` runs the Python of this one page.
            let is_python = language == "python" && page != Path::new("docs/python.md");
            if !is_python && !SHELLS.contains(&language) {
                continue;
            }
            let place = format!("{}:{line}", page.display());
            if let Some(reason) = rest.strip_prefix("not-run:") {
                assert!(!reason.trim().is_empty(), "{place} does not say why it is not run");
                continue;
            }
            let is_run = rest.is_empty() && !is_python;
            assert!(is_run, "{place}: ```{info} is neither run nor not-run: REASON");
            let commands = commands(language, &text);
            assert!(!commands.is_empty(), "{place} has no commands");
            let mut command = Command::new("bash");
            command.args(["-euo", "pipefail", "-c", &commands]).env("PATH", &path);
            command.current_dir(folder.path()).stdin(Stdio::null());
            isolate(&mut command, folder.path());
            let output = command.output().unwrap();
            assert!(
                output.status.success(),
                "{place} ends with {}\n{commands}{}{}",
                output.status,
                String::from_utf8_lossy(&output.stdout),
                String::from_utf8_lossy(&output.stderr)
            );
            run += 1;
        }
    }
    assert!(run > 3, "only {run} blocks were run");
}
