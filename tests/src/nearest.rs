//! The known word that a wrong one is meant to be.

/// Letters of a wrong word that are looked at; more is no slip of the fingers.
const LETTERS_MAX: usize = 64;

/// The known word nearest to `word`, when fewer than half of its letters are wrong.
pub(crate) fn nearest<'a>(word: &str, known: &[&'a str]) -> Option<&'a str> {
    let nearest = known.iter().copied().min_by_key(|n| edits(word, n));
    nearest.filter(|n| edits(word, n) <= n.chars().count() / 2)
}

/// `; did you mean "..."?`, or nothing.
pub(crate) fn did_you_mean(word: &str, known: &[&str]) -> String {
    let nearest = nearest(word, known);
    nearest.map_or(String::new(), |n| format!("; did you mean \"{n}\"?"))
}

/// What serde says of a key or a kind that it does not know, with the one that is meant. It names the wrong word first and
/// then the known ones, each between two backquotes.
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

/// How many letters must be changed, added or taken away to make one word of the other.
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
    fn a_slip_of_the_fingers_is_found_and_another_word_is_not() {
        let known = ["delay_ms", "loss", "jitter"];
        assert_eq!(nearest("deley_ms", &known), Some("delay_ms"));
        assert_eq!(nearest("los", &known), Some("loss"));
        assert_eq!(nearest("qqqq", &known), None);
        assert_eq!(nearest("", &[]), None);
    }

    #[test]
    fn what_is_wrong_in_a_file_comes_with_what_is_meant() {
        let said = with_nearest("line 3: unknown field `sede`, expected one of `seed`, `seeds`\n");
        assert!(said.ends_with("did you mean \"seed\"?"), "{said}");
        assert_eq!(with_nearest("invalid type"), "invalid type");
        assert_eq!(with_nearest("unknown field"), "unknown field");
    }
}
