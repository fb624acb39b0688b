//! Law of an overloaded machine, in virtual time: fixed-priority pre-emptive scheduling of budgeted threads.

use proptest::prelude::*;

use super::*;

/// Time step of the scheduler, µs.
const STEP_US: i64 = 100;

/// A periodic loop as the scheduler sees it.
struct Loop {
    class: ThreadClass,
    period_us: i64,
    /// CPU time of one turn.
    work_us: i64,
    budget: CpuBudget,
    next_us: i64,
    left_us: i64,
    turns: u32,
    used_us: i64,
}

impl Loop {
    fn new(class: ThreadClass, period_us: i64, work_us: i64) -> Self {
        Self {
            class,
            period_us,
            work_us,
            budget: class.budget(),
            next_us: 0,
            left_us: 0,
            turns: 0,
            used_us: 0,
        }
    }

    /// Whether it wants the processor. A turn that is due begins.
    fn is_ready(&mut self, now_us: i64) -> bool {
        if self.left_us <= 0 && now_us >= self.next_us {
            self.left_us = self.work_us;
        }
        self.left_us > 0
    }

    fn run(&mut self, now_us: i64) {
        self.left_us -= STEP_US;
        self.used_us += STEP_US;
        if self.left_us <= 0 {
            self.turns += 1;
            let rest = self.budget.charge(now_us, Span::from_micros(self.work_us));
            self.next_us = (self.next_us + self.period_us)
                .max(now_us)
                .max(now_us + rest.as_micros());
        }
    }
}

/// Runs the loops for a while on `cores` processors; the most urgent class first.
fn run(loops: &mut [Loop], cores: usize, seconds: i64) {
    loops.sort_by_key(|l| l.class);
    for now_us in (0..seconds * 1_000_000).step_by(STEP_US as usize) {
        let mut free = cores;
        for l in loops.iter_mut() {
            if free > 0 && l.is_ready(now_us) {
                l.run(now_us + STEP_US);
                free -= 1;
            }
        }
        // Threads of one class take turns.
        let view = loops.partition_point(|l| l.class < ThreadClass::Background);
        loops[view..].rotate_left(1);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    /// However much work solvers and views have: the force loop keeps its rate, solvers get their whole budget before
    /// views get anything beyond the rest, and the rest always goes to views.
    #[test]
    fn an_overloaded_machine_slows_views_first_then_solvers_and_never_the_force(
        solver_work_us in 1_000_i64..40_000,
        view_work_us in 5_000_i64..200_000,
        views in 1_usize..5,
    ) {
        let seconds = 4;
        let mut loops = vec![
            Loop::new(ThreadClass::Force, 1_000, 100),
            Loop::new(ThreadClass::HandSolver, 4_000, solver_work_us / STEP_US * STEP_US),
        ];
        for _ in 0..views {
            loops.push(Loop::new(ThreadClass::Background, 33_000, view_work_us / STEP_US * STEP_US));
        }
        run(&mut loops, 1, seconds);
        let of = |class| loops.iter().filter(move |l| l.class == class);
        let share = |class| of(class).map(|l| l.used_us).sum::<i64>() as f64 / (seconds * 1_000_000) as f64;
        let force = of(ThreadClass::Force).next().unwrap();
        prop_assert!(force.turns >= (seconds * 1000) as u32 - 1, "{} turns", force.turns);
        let wanted = solver_work_us as f64 / 4_000.0;
        let solver = share(ThreadClass::HandSolver);
        // One overrun more than the budget at most.
        let overrun = solver_work_us as f64 / (seconds * 1_000_000) as f64;
        prop_assert!(solver <= 0.5 + overrun + 0.01, "solver {solver}");
        prop_assert!(solver >= wanted.min(0.5) - overrun - 0.05, "solver {solver} of {wanted}");
        let view_wanted = views as f64 * view_work_us as f64 / 33_000.0;
        let rest = 1.0 - 0.1 - solver;
        let view = share(ThreadClass::Background);
        prop_assert!(view >= view_wanted.min(rest) * 0.95 - 0.06, "views {view} of {view_wanted}, rest {rest}");
    }
}

/// The machine of the demo with a solver and a view per trainee: both solvers keep 250 Hz while views want far more
/// than there is.
#[test]
fn overloaded_views_do_not_slow_the_solvers() {
    let mut loops = vec![
        Loop::new(ThreadClass::Force, 1_000, 100),
        Loop::new(ThreadClass::Force, 1_000, 100),
        Loop::new(ThreadClass::HandSolver, 4_000, 1_500),
        Loop::new(ThreadClass::HandSolver, 4_000, 1_500),
    ];
    for _ in 0..3 {
        loops.push(Loop::new(ThreadClass::Background, 33_000, 100_000));
    }
    run(&mut loops, 2, 4);
    for l in loops.iter().filter(|l| l.class == ThreadClass::HandSolver) {
        assert!(l.turns >= 990, "{} turns in 4 s", l.turns);
    }
    let views = loops
        .iter()
        .filter(|l| l.class == ThreadClass::Background)
        .map(|l| l.turns);
    assert!(
        views.clone().all(|turns| turns > 0),
        "{:?}",
        views.collect::<Vec<_>>()
    );
}
