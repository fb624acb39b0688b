//! Cells of CSV, terminal and HTML tables.
//!
//! Displayed numbers have four significant digits. All numbers of a column have the same number of
//! decimals.

use serde_json::Value;

/// Maximum number of displayed list elements.
const LIST_MAX: usize = 16;

/// Significant digits of a column's largest number or a single number, and minimum for the column's
/// smallest.
const DIGITS: i32 = 4;
const DIGITS_MIN: i32 = 2;

/// Maximum number of decimals that the smallest number of a column adds.
const MORE_MAX: i32 = 3;

/// Splits a line of a CSV file. Quoted cells may contain commas and doubled quotes.
pub(super) fn split(line: &str) -> Vec<String> {
    let mut cells = vec![String::new()];
    let mut is_quoted = false;
    let mut letters = line.chars().peekable();
    while let Some(letter) = letters.next() {
        let last = cells.len() - 1;
        match letter {
            '"' if is_quoted && letters.peek() == Some(&'"') => {
                letters.next();
                cells[last].push('"');
            }
            '"' => is_quoted = !is_quoted,
            ',' if !is_quoted => cells.push(String::new()),
            _ => cells[last].push(letter),
        }
    }
    cells
}

/// A CSV cell: strings with commas or quotes are quoted, null is empty.
pub(super) fn of_file(value: &Value) -> String {
    match value {
        Value::Null => String::new(),
        Value::String(word) if word.contains([',', '"', '\n']) => {
            format!("\"{}\"", word.replace('"', "\"\""))
        }
        Value::String(word) => word.clone(),
        other => other.to_string(),
    }
}

/// A figure with all digits; [`aligned`] shortens whole columns.
pub(super) fn whole(value: &Value) -> String {
    match value {
        Value::Null => "–".to_owned(),
        Value::String(word) => word.clone(),
        Value::Array(_) => alone(value),
        other => other.to_string(),
    }
}

/// A single figure, outside a column.
pub(super) fn alone(value: &Value) -> String {
    match value {
        Value::Number(n) if n.is_f64() => n.as_f64().map_or(String::new(), number),
        Value::Bool(yes) => truth(*yes).to_owned(),
        Value::Array(values) => {
            let mut cells: Vec<String> = values.iter().take(LIST_MAX).map(alone).collect();
            if values.len() > LIST_MAX {
                cells.push(format!("… {} in all", values.len()));
            }
            cells.join(", ")
        }
        other => whole(other),
    }
}

fn truth(yes: bool) -> &'static str {
    if yes { "yes" } else { "no" }
}

/// A single number with four significant digits.
pub(super) fn number(x: f64) -> String {
    if x == 0.0 {
        return "0".to_owned();
    }
    if !(1e-4..1e7).contains(&x.abs()) {
        return format!("{x:.2e}");
    }
    let digits = decimals(x, DIGITS).clamp(0, 7) as usize;
    format!("{x:.digits$}")
}

/// Decimals that show `digits` significant digits of `x`.
fn decimals(x: f64, digits: i32) -> i32 {
    digits - 1 - x.abs().log10().floor() as i32
}

/// Gives the numbers of each column equal decimals and replaces booleans by yes and no.
pub(super) fn aligned(rows: &mut [Vec<String>]) {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    for k in 0..columns {
        let numbers: Vec<f64> = (rows.iter())
            .filter_map(|row| row.get(k)?.parse::<f64>().ok())
            .filter(|x| x.is_finite())
            .collect();
        let digits = of_column(&numbers);
        for cell in rows.iter_mut().filter_map(|row| row.get_mut(k)) {
            match (cell.as_str(), cell.parse::<f64>()) {
                ("true", _) => truth(true).clone_into(cell),
                ("false", _) => truth(false).clone_into(cell),
                (_, Ok(x)) if x.is_finite() => *cell = format!("{x:.digits$}"),
                (_, Ok(_)) | ("", Err(_)) => "–".clone_into(cell),
                _ => {}
            }
        }
    }
}

/// Decimals of a column; whole numbers have none.
fn of_column(numbers: &[f64]) -> usize {
    if numbers.iter().all(|x| x.fract() == 0.0) {
        return 0;
    }
    let sizes = || numbers.iter().map(|x| x.abs()).filter(|x| *x > 0.0);
    let largest = decimals(sizes().fold(0.0, f64::max), DIGITS).max(0);
    let smallest = decimals(sizes().fold(f64::INFINITY, f64::min), DIGITS_MIN);
    smallest.clamp(largest, largest + MORE_MAX) as usize
}

/// Formats CSV as a terminal table: words left-aligned, numbers right-aligned.
pub(super) fn in_columns(text: &str) -> String {
    let mut rows: Vec<Vec<String>> = text.lines().map(split).collect();
    let Some((head, body)) = rows.split_first_mut() else {
        return String::new();
    };
    aligned(body);
    let columns: Vec<(usize, bool)> = (0..head.len())
        .map(|k| {
            let cells = || body.iter().filter_map(|row| row.get(k));
            let width = cells().map(|c| c.chars().count()).max().unwrap_or(0);
            (
                width.max(head[k].chars().count()),
                cells().any(|c| is_word(c)),
            )
        })
        .collect();
    let line = |row: &Vec<String>| {
        let cells = row.iter().zip(&columns).map(|(cell, (width, is_word))| {
            if *is_word {
                format!("{cell:<width$}")
            } else {
                format!("{cell:>width$}")
            }
        });
        let line = cells.collect::<Vec<_>>().join("  ");
        line.trim_end().to_owned() + "\n"
    };
    rows.iter().map(line).collect()
}

/// Whether the cell makes its column a text column.
pub(super) fn is_word(cell: &str) -> bool {
    cell.parse::<f64>().is_err() && cell.chars().any(char::is_alphabetic)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    #[test]
    fn single_numbers_have_four_significant_digits() {
        let shown = [1234.56, 0.012_345_6, -2.0, 0.0, 1e-9, 3e8].map(number);
        assert_eq!(
            shown,
            ["1235", "0.01235", "-2.000", "0", "1.00e-9", "3.00e8"]
        );
    }

    fn column(cells: &[&str]) -> Vec<String> {
        let mut rows: Vec<Vec<String>> = cells.iter().map(|c| vec![(*c).to_owned()]).collect();
        aligned(&mut rows);
        rows.concat()
    }

    #[test]
    fn numbers_of_a_column_have_equal_decimals() {
        assert_eq!(column(&["0.00361234", "5.10406"]), ["0.0036", "5.1041"]);
        assert_eq!(column(&["1.0000", "64.0000"]), ["1", "64"]);
        assert_eq!(column(&["97.4", "324.1972", "0"]), ["97.4", "324.2", "0.0"]);
        assert_eq!(
            column(&["1e-12", "2.5", "word"]),
            ["0.000000", "2.500000", "word"]
        );
        assert_eq!(column(&["true", "", "NaN"]), ["yes", "–", "–"]);
    }

    #[test]
    fn terminal_tables_align_numbers() {
        let shown = in_columns("network,sessions,mm\n\"200 ms, 5 %\",20,0.05123\nlan,4,1.25\n");
        let lines: Vec<&str> = shown.lines().collect();
        assert_eq!(lines[1], "200 ms, 5 %        20  0.051");
        assert_eq!(lines[2], "lan                 4  1.250");
        assert_eq!(in_columns(""), "");
    }

    proptest! {
        #[test]
        fn csv_cells_survive_a_round_trip(words in prop::collection::vec("[a-z,\" ]{0,8}", 1..6)) {
            let line: Vec<String> = words.iter().map(|w| of_file(&json!(w))).collect();
            prop_assert_eq!(split(&line.join(",")), words);
        }

        #[test]
        fn column_rounding_error_is_bounded_by_the_largest_number(numbers in prop::collection::vec(-1e6..1e6f64, 1..9)) {
            let cells: Vec<String> = numbers.iter().map(ToString::to_string).collect();
            let shown = column(&cells.iter().map(String::as_str).collect::<Vec<_>>());
            for (shown, x) in shown.iter().zip(&numbers) {
                prop_assert!((shown.parse::<f64>().unwrap() - x).abs() <= 5e-4 * numbers.iter().fold(0.0, |a: f64, b| a.max(b.abs())));
            }
        }
    }
}
