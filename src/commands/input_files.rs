//! Checks of the files that a command reads.

use std::collections::BTreeSet;
use std::path::PathBuf;

/// The first of these paths that names the file of an earlier path, even in another spelling; `None`
/// if each file is named once.
pub fn duplicate<'a>(files: impl IntoIterator<Item = &'a PathBuf>) -> Option<&'a PathBuf> {
    let mut seen = BTreeSet::new();
    files.into_iter().find(|path| {
        let whole = path.canonicalize().unwrap_or_else(|_| PathBuf::from(path));
        !seen.insert(whole)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_named_twice_even_by_another_path() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.mcap");
        std::fs::write(&file, "").unwrap();
        let indirect =
            folder.path().join("..").join(folder.path().file_name().unwrap()).join("a.mcap");
        let missing = folder.path().join("b.mcap");
        assert_eq!(duplicate([&file, &missing]), None);
        assert_eq!(duplicate([&file, &missing, &indirect]), Some(&indirect));
        assert_eq!(duplicate([&missing, &missing]), Some(&missing));
    }
}
