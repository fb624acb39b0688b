//! CPU time by thread class.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::ThreadClass;

/// CPU time of a process at one moment, by class.
#[derive(Debug, Clone, Default, PartialEq)]
#[allow(clippy::struct_field_names, reason = "names carry their unit")]
pub struct CpuTime {
    pub(super) at_ns: i64,
    pub(super) process_ns: i64,
    pub(super) classes_ns: BTreeMap<ThreadClass, i64>,
}

/// Mean use of the processor over an interval.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CpuUsage {
    /// Processor cores used by the process, on average.
    pub cores: f64,
    /// The share of each thread class; `other` has threads without a class.
    pub classes: BTreeMap<String, f64>,
    /// Length of the interval in s.
    pub seconds: f64,
}

impl CpuTime {
    /// The usage since an earlier moment.
    #[must_use]
    pub fn since(&self, before: &Self) -> Self {
        let less = |(class, ns): (&ThreadClass, &i64)| {
            (*class, ns - before.classes_ns.get(class).unwrap_or(&0))
        };
        Self {
            at_ns: self.at_ns - before.at_ns,
            process_ns: self.process_ns - before.process_ns,
            classes_ns: self.classes_ns.iter().map(less).collect(),
        }
    }

    /// Seconds of CPU time in a class.
    #[cfg(test)]
    pub(super) fn seconds_of(&self, class: ThreadClass) -> f64 {
        self.classes_ns
            .get(&class)
            .map_or(0.0, |ns| *ns as f64 * 1e-9)
    }

    /// The mean use between an earlier moment and this one.
    pub fn usage_since(&self, before: &Self) -> CpuUsage {
        let used = self.since(before);
        let seconds = (used.at_ns as f64 * 1e-9).max(1e-9);
        let cores = |ns: i64| ns as f64 * 1e-9 / seconds;
        let known: i64 = used.classes_ns.values().sum();
        let mut classes: BTreeMap<String, f64> = used
            .classes_ns
            .iter()
            .map(|(class, ns)| (class.word().to_owned(), cores(*ns)))
            .collect();
        classes.insert("other".to_owned(), cores((used.process_ns - known).max(0)));
        CpuUsage {
            cores: cores(used.process_ns),
            classes,
            seconds,
        }
    }
}

impl std::fmt::Display for CpuUsage {
    /// One line: the total and the classes that used anything.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.2} cores", self.cores)?;
        let used = self.classes.iter().filter(|(_, cores)| **cores >= 0.005);
        for (i, (word, cores)) in used.enumerate() {
            let before = if i == 0 { " (" } else { ", " };
            write!(f, "{before}{word} {cores:.2}")?;
        }
        if self.classes.values().any(|cores| *cores >= 0.005) {
            write!(f, ")")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classes_and_the_rest_add_up_to_the_process() {
        let before = CpuTime::default();
        let after = CpuTime {
            at_ns: 2_000_000_000,
            process_ns: 1_000_000_000,
            classes_ns: [
                (ThreadClass::Force, 100_000_000),
                (ThreadClass::Network, 300_000_000),
            ]
            .into(),
        };
        let usage = after.usage_since(&before);
        assert!((usage.cores - 0.5).abs() < 1e-12);
        assert!((usage.classes["other"] - 0.3).abs() < 1e-12);
        assert!((usage.classes.values().sum::<f64>() - usage.cores).abs() < 1e-12);
        assert_eq!(
            usage.to_string(),
            "0.50 cores (force 0.05, network 0.15, other 0.30)"
        );
    }
}
