//! Real-time priority where the system allows it, and a sentence for the user where not.

use super::sys;

/// How the haptic thread is scheduled.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Priority {
    /// It goes before every ordinary thread.
    RealTime {
        /// The priority under `SCHED_FIFO`.
        priority: i32,
    },
    /// It takes its turn like everybody else.
    Normal {
        /// One sentence for the user: why, what that means, what to do.
        explanation: String,
    },
}

impl Priority {
    /// The sentence for the user, if there is something to say.
    pub fn explanation(&self) -> Option<&str> {
        match self {
            Self::RealTime { .. } => None,
            Self::Normal { explanation } => Some(explanation),
        }
    }
}

/// Gives this thread `priority` under `SCHED_FIFO`, or says why not. `None` does not try.
pub(super) fn raise_this_thread(priority: Option<i32>) -> Priority {
    sys::tighten_timers();
    let Some(priority) = priority else {
        let explanation = "The force loop runs without real-time priority, as configured, so it \
             may be late when the machine is busy.";
        return Priority::Normal {
            explanation: explanation.to_owned(),
        };
    };
    match sys::set_fifo(priority) {
        Ok(()) => Priority::RealTime { priority },
        Err(why) => Priority::Normal {
            explanation: format!(
                "The force loop runs without real-time priority ({why}), so it may be late when \
                 the machine is busy: allow it with `ulimit -r {priority}` before starting \
                 (`rtprio` in /etc/security/limits.conf) or with `setcap cap_sys_nice=ep` on the \
                 program."
            ),
        },
    }
}

/// Lets the calling thread give way to others by `nice` (0 to 19), so that a solver does not
/// take the processor from the network and the view. Best effort: whether it was granted.
pub fn lower_priority_of_this_thread(nice: i32) -> bool {
    sys::set_nice(nice)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::{Priority, raise_this_thread};

    #[test]
    fn a_refusal_is_one_sentence_that_says_what_to_do() {
        // No system has this priority, so it is refused whoever runs the test.
        let refused = std::thread::spawn(|| raise_this_thread(Some(12_345)))
            .join()
            .unwrap();
        let text = refused.explanation().unwrap();
        assert!(
            text.contains("ulimit -r") && text.contains("cap_sys_nice"),
            "{text}"
        );
        assert!(matches!(raise_this_thread(None), Priority::Normal { .. }));
    }
}
