//! Finds the paths and the literals of a source file among its tokens, and follows each path from
//! the crate's root.

use std::str::FromStr;

use proc_macro2::{Delimiter, LineColumn, Spacing, TokenStream, TokenTree};

/// A path, from the crate's root, from another crate or from a name of the module itself.
#[derive(Debug, PartialEq, Eq)]
pub struct Import {
    /// `crate`, or the name at which the path begins, then the segments after it.
    pub path: Vec<String>,
    pub line: usize,
    pub in_tests: bool,
    pub is_public_use: bool,
}

/// All paths of a file that have two segments or more or stand in a `use`.
pub fn imports(module: &[String], source: &str) -> Vec<Import> {
    let tokens = TokenStream::from_str(source).unwrap_or_else(|error| panic!("{error}: {source}"));
    let mut walk = Walk { imports: Vec::new(), in_tests: false, is_public_use: false, line: None };
    walk.tokens(module, tokens);
    walk.imports
}

/// The literals of a source file outside its tests and its documentation, each with its line.
pub fn literals(module: &[String], source: &str) -> Vec<(usize, String)> {
    if is_of_tests(module) {
        return Vec::new();
    }
    let tokens = TokenStream::from_str(source).unwrap_or_else(|error| panic!("{error}: {source}"));
    let mut found = Vec::new();
    push_literals(tokens.into_iter().collect(), &mut found);
    found
}

/// Returns whether a module belongs to the tests. A file of tests is declared under `#[cfg(test)]`
/// in another file, so it is recognised by its name.
fn is_of_tests(module: &[String]) -> bool {
    module
        .iter()
        .any(|part| ["tests", "samples"].contains(&part.as_str()) || part.ends_with("_tests"))
}

fn push_literals(tokens: Vec<TokenTree>, found: &mut Vec<(usize, String)>) {
    let mut rest = tokens.as_slice();
    while let [first, after @ ..] = rest {
        rest = after;
        match (first, after) {
            (hash, [TokenTree::Group(attribute), item @ ..])
                if is_punct(hash, '#') && is_cfg_test(&attribute.stream()) =>
            {
                rest = &item[item_length(item)..];
            }
            (TokenTree::Ident(name), [equals, TokenTree::Literal(_), after @ ..])
                if name == "doc" && is_punct(equals, '=') =>
            {
                rest = after;
            }
            (TokenTree::Group(group), _) => {
                push_literals(group.stream().into_iter().collect(), found);
            }
            (TokenTree::Literal(literal), _) => {
                found.push((literal.span().start().line, literal.to_string()));
            }
            _ => {}
        }
    }
}

struct Walk {
    imports: Vec<Import>,
    in_tests: bool,
    is_public_use: bool,
    /// Line of an attribute's text, whose tokens count their lines from 1 again.
    line: Option<usize>,
}

impl Walk {
    fn tokens(&mut self, module: &[String], tokens: TokenStream) {
        let tokens: Vec<TokenTree> = tokens.into_iter().collect();
        let before = self.in_tests;
        self.in_tests |= is_of_tests(module);
        let mut position = 0;
        while position < tokens.len() {
            position += self.item(module, &tokens[position..]);
        }
        self.in_tests = before;
    }

    /// Reads the item that starts here; returns its number of tokens.
    fn item(&mut self, module: &[String], rest: &[TokenTree]) -> usize {
        match rest {
            // An item under #[cfg(test)] is test code up to its braces or its semicolon.
            [hash, TokenTree::Group(attribute), item @ ..]
                if is_punct(hash, '#') && is_cfg_test(&attribute.stream()) =>
            {
                let length = item_length(item);
                let before = std::mem::replace(&mut self.in_tests, true);
                self.tokens(module, item[..length].iter().cloned().collect());
                self.in_tests = before;
                2 + length
            }
            [keyword, TokenTree::Ident(name), TokenTree::Group(body), ..]
                if is_ident(keyword, "mod") && body.delimiter() == Delimiter::Brace =>
            {
                let inner = [module, &[name.to_string()]].concat();
                self.tokens(&inner, body.stream());
                3
            }
            [extern_, krate, TokenTree::Ident(name), ..]
                if is_ident(extern_, "extern") && is_ident(krate, "crate") =>
            {
                let name = if name == "self" { "crate".to_owned() } else { name.to_string() };
                self.push(vec![name], krate.span().start());
                3
            }
            [keyword, ..] if is_ident(keyword, "use") || is_ident(keyword, "pub") => {
                let Some((start, end)) = use_item(rest) else { return 1 };
                self.is_public_use = is_ident(keyword, "pub");
                for branch in branches(&rest[start..end]) {
                    self.path(module, &Base::Unknown, branch);
                }
                self.is_public_use = false;
                end
            }
            [TokenTree::Ident(_), first, second, ..]
                if is_joint_colon(first) && is_punct(second, ':') =>
            {
                let length = path_length(rest);
                self.path(module, &Base::Unknown, &rest[..length]);
                length
            }
            [TokenTree::Group(group), ..] => {
                self.tokens(module, group.stream());
                1
            }
            // `#[serde(with = "crate::x")]` is a path as well.
            [TokenTree::Literal(literal), ..] => {
                let text = literal.to_string();
                let text = text.trim_matches('"');
                let heads = ["crate::", "super::", "qube_hil::"];
                if heads.iter().any(|head| text.starts_with(head))
                    && let Ok(tokens) = TokenStream::from_str(text)
                {
                    let before = self.line.replace(literal.span().start().line);
                    self.tokens(module, tokens);
                    self.line = before;
                }
                1
            }
            _ => 1,
        }
    }

    /// Follows one path and its groups.
    fn path(&mut self, module: &[String], base: &Base, tokens: &[TokenTree]) {
        let tokens = if is_separator(tokens) { &tokens[2..] } else { tokens };
        let Some((head, rest)) = tokens.split_first() else { return };
        let at = head.span().start();
        match head {
            TokenTree::Group(group) => {
                let inner: Vec<TokenTree> = group.stream().into_iter().collect();
                for branch in branches(&inner) {
                    self.path(module, base, branch);
                }
            }
            TokenTree::Punct(star) if star.as_char() == '*' => {
                if let Some(mut path) = base.segments() {
                    path.push("*".to_owned());
                    self.push(path, at);
                }
            }
            TokenTree::Ident(name) => {
                let next = base.step(module, &name.to_string());
                if is_separator(rest) {
                    self.path(module, &next, rest);
                } else if let Some(path) = next.segments() {
                    self.push(path, at);
                }
            }
            _ => {}
        }
    }

    fn push(&mut self, path: Vec<String>, at: LineColumn) {
        let line = self.line.unwrap_or(at.line);
        let (in_tests, is_public_use) = (self.in_tests, self.is_public_use);
        self.imports.push(Import { path, line, in_tests, is_public_use });
    }
}

/// The place that a path has reached so far.
#[derive(Clone, Debug)]
enum Base {
    /// The path has not begun.
    Unknown,
    /// The path has reached a module of this crate.
    Inside(Vec<String>),
    /// The path has reached another crate, or a name of the module itself.
    Outside(Vec<String>),
}

impl Base {
    fn step(&self, module: &[String], name: &str) -> Self {
        let parent = |of: &[String]| of[..of.len().saturating_sub(1)].to_vec();
        match (self, name) {
            (Self::Unknown, "crate" | "qube_hil") => Self::Inside(Vec::new()),
            (Self::Unknown, "self") => Self::Inside(module.to_vec()),
            (Self::Unknown, "super") => Self::Inside(parent(module)),
            (Self::Unknown, _) => Self::Outside(vec![name.to_owned()]),
            (Self::Inside(inside), "super") => Self::Inside(parent(inside)),
            (Self::Inside(_) | Self::Outside(_), "self") => self.clone(),
            (Self::Inside(inside), _) => Self::Inside([inside, &[name.to_owned()][..]].concat()),
            (Self::Outside(outside), _) => {
                Self::Outside([outside, &[name.to_owned()][..]].concat())
            }
        }
    }

    fn segments(&self) -> Option<Vec<String>> {
        match self {
            Self::Unknown => None,
            Self::Inside(path) => Some([&["crate".to_owned()], path.as_slice()].concat()),
            Self::Outside(path) => Some(path.clone()),
        }
    }
}

pub fn is_ident(token: &TokenTree, name: &str) -> bool {
    matches!(token, TokenTree::Ident(ident) if ident == name)
}

fn is_punct(token: &TokenTree, wanted: char) -> bool {
    matches!(token, TokenTree::Punct(punct) if punct.as_char() == wanted)
}

fn is_joint_colon(token: &TokenTree) -> bool {
    matches!(token, TokenTree::Punct(punct)
        if punct.as_char() == ':' && punct.spacing() == Spacing::Joint)
}

fn is_separator(tokens: &[TokenTree]) -> bool {
    matches!(tokens, [first, second, ..] if is_joint_colon(first) && is_punct(second, ':'))
}

fn is_cfg_test(attribute: &TokenStream) -> bool {
    attribute.to_string().replace(' ', "") == "cfg(test)"
}

/// Number of tokens of the item that starts here, up to its braces or its semicolon.
fn item_length(tokens: &[TokenTree]) -> usize {
    let is_end = |token: &TokenTree| {
        is_punct(token, ';')
            || matches!(token, TokenTree::Group(group) if group.delimiter() == Delimiter::Brace)
    };
    // The braces of `use a::{b, c};` are not its end.
    match use_item(tokens) {
        Some((_, end)) => (end + 1).min(tokens.len()),
        None => tokens.iter().position(is_end).map_or(tokens.len(), |end| end + 1),
    }
}

/// The range of the tokens between `use` and the semicolon of a `use` item with any visibility; the
/// second index points to the semicolon.
fn use_item(tokens: &[TokenTree]) -> Option<(usize, usize)> {
    let start = match tokens {
        [first, ..] if is_ident(first, "use") => 1,
        [_, second, ..] if is_ident(second, "use") => 2,
        [_, TokenTree::Group(_), third, ..] if is_ident(third, "use") => 3,
        _ => return None,
    };
    let length = tokens[start..].iter().position(|token| is_punct(token, ';'))?;
    Some((start, start + length))
}

/// Number of tokens of the path that starts here.
fn path_length(tokens: &[TokenTree]) -> usize {
    let mut length = 1;
    while is_separator(&tokens[length..]) {
        match tokens.get(length + 2) {
            Some(TokenTree::Ident(_)) => length += 3,
            _ => return length,
        }
    }
    length
}

/// The parts of a group between its commas.
fn branches(tokens: &[TokenTree]) -> Vec<&[TokenTree]> {
    tokens.split(|token| is_punct(token, ',')).filter(|branch| !branch.is_empty()).collect()
}
