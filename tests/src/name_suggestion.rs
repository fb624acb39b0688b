//! Suggests the known name that is nearest to a misspelt one.

/// Maximum number of compared letters; a longer name is not a typing error.
const LETTERS_MAX: usize = 64;

/// The known name nearest to `word`, if fewer than half of its letters differ.
pub(crate) fn nearest<'a>(word: &str, known: &[&'a str]) -> Option<&'a str> {
    let nearest = known.iter().copied().min_by_key(|n| edits(word, n));
    nearest.filter(|n| edits(word, n) <= n.chars().count() / 2)
}

/// `; did you mean "..."?`, or an empty string.
pub(crate) fn did_you_mean(word: &str, known: &[&str]) -> String {
    let nearest = nearest(word, known);
    nearest.map_or(String::new(), |n| format!("; did you mean \"{n}\"?"))
}

/// A serde error for an unknown key or variant, with a suggestion. serde prints the unknown name first and then
/// the known ones, each in backquotes.
pub(crate) fn with_nearest(said: &str) -> String {
    let said = said.trim_end();
    let Some(from) = (said.find("unknown field")).or_else(|| said.find("unknown variant")) else {
        return said.to_owned();
    };
    let words: Vec<&str> = said[from..].split('`').skip(1).step_by(2).collect();
    match words.split_first() {
        Some((wrong, known)) => format!("{said}{}", did_you_mean(wrong, known)),
        None => said.to_owned(),
    }
}

/// Edit distance: letters changed, added or removed.
fn edits(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, ca) in a.chars().take(LETTERS_MAX).enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, cb) in b.iter().enumerate() {
            let change = diagonal + usize::from(ca != *cb);
            diagonal = row[j + 1];
            row[j + 1] = change.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::{nearest, with_nearest};

    #[test]
    fn typing_error_gets_a_suggestion_and_another_word_does_not() {
        let known = ["delay_ms", "loss", "jitter"];
        assert_eq!(nearest("deley_ms", &known), Some("delay_ms"));
        assert_eq!(nearest("los", &known), Some("loss"));
        assert_eq!(nearest("qqqq", &known), None);
        assert_eq!(nearest("", &[]), None);
    }

    #[test]
    fn serde_error_gets_a_suggestion() {
        let said = with_nearest("line 3: unknown field `sede`, expected one of `seed`, `seeds`\n");
        assert!(said.ends_with("did you mean \"seed\"?"), "{said}");
        assert_eq!(with_nearest("invalid type"), "invalid type");
        assert_eq!(with_nearest("unknown field"), "unknown field");
    }
}
