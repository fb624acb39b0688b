//! The suggestion of a message about an unknown name.

/// Edits per letter beyond which a name is not suggested. Reason: "musle" is one edit from "muscle"; names
/// further than half their letters apart are unrelated.
const EDITS_PER_LETTER_MAX: f64 = 0.5;

/// The known name most similar to `name`, if any is similar at all.
pub fn nearest_name<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let lower = name.to_lowercase();
    known
        .into_iter()
        .map(|k| (strsim::damerau_levenshtein(&lower, &k.to_lowercase()), k))
        .filter(|(edits, k)| {
            let letters = k.chars().count().max(lower.chars().count());
            *edits as f64 <= EDITS_PER_LETTER_MAX * letters as f64
        })
        .min()
        .map(|(_, k)| k)
}
