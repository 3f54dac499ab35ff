//! Gives the program the revision that it is built from, so that each recording can name it.

use std::path::{Path, PathBuf};
use std::process::Command;

fn main() {
    let revision = git(&["rev-parse", "--short=12", "HEAD"]).filter(|_| is_repository());
    let revision = revision.unwrap_or_else(|| "unknown".into());
    println!("cargo:rustc-env=QUBE_HIL_GIT_REVISION={revision}");
    println!("cargo:rerun-if-changed=build.rs");
    if let Some(directory) = git(&["rev-parse", "--absolute-git-dir"]) {
        println!("cargo:rerun-if-changed={directory}/logs/HEAD");
    }
}

/// Returns whether this folder is a repository of its own. Git also finds a repository that
/// contains this folder, such as the project of a user who unpacked an archive inside it.
fn is_repository() -> bool {
    let here = std::env::var_os("CARGO_MANIFEST_DIR").map(PathBuf::from);
    let top = git(&["rev-parse", "--show-toplevel"]);
    let (Some(here), Some(top)) = (here, top) else { return false };
    match (here.canonicalize(), Path::new(&top).canonicalize()) {
        (Ok(here), Ok(top)) => here == top,
        _ => false,
    }
}

/// Returns the output of a git command; `None` without git, and if the command fails (as outside a
/// repository) or prints nothing.
fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    let printed = String::from_utf8(output.stdout).ok()?.trim().to_owned();
    (output.status.success() && !printed.is_empty()).then_some(printed)
}
