//! The cut worker: prepares cuts while the replica's thread serves the hand.

use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};

use palpate_site::{CutOrder, MadeCut, Prefetch, ReplicaError};
use palpate_transport::threads::{self, ThreadClass};

use crate::realtime::single_thread_pool;

/// A thread that prepares cuts in log order and unparks the one that created it after each. Dropping this ends it.
pub(crate) struct CutWorker {
    orders: Sender<CutOrder>,
    news: Receiver<Result<MadeCut, ReplicaError>>,
}

impl CutWorker {
    pub(crate) fn spawn(prefetch: Prefetch) -> std::io::Result<Self> {
        let (orders, received) = channel();
        let (results, news) = channel();
        let reader = std::thread::current();
        threads::spawn(ThreadClass::Cut, "cuts", move || {
            let _pool = single_thread_pool();
            serve(prefetch, &received, &|news| {
                let sent = results.send(news);
                reader.unpark();
                sent.is_ok()
            });
        })?;
        Ok(Self { orders, news })
    }

    /// Sends an order to the worker.
    pub(crate) fn order(&self, order: CutOrder) -> Result<(), ReplicaError> {
        self.orders.send(order).map_err(|_| ended())
    }

    /// The next result, if any. An error if the thread has stopped, so that no operation waits forever.
    pub(crate) fn poll(&self) -> Result<Option<MadeCut>, ReplicaError> {
        match self.news.try_recv() {
            Ok(news) => news.map(Some),
            Err(TryRecvError::Empty) => Ok(None),
            Err(TryRecvError::Disconnected) => Err(ended()),
        }
    }
}

fn ended() -> ReplicaError {
    ReplicaError::Ended {
        operation: "a cut".to_owned(),
    }
}

fn serve(
    mut prefetch: Prefetch,
    received: &Receiver<CutOrder>,
    answer: &dyn Fn(Result<MadeCut, ReplicaError>) -> bool,
) {
    loop {
        if !prefetch.can_work() {
            let Ok(order) = received.recv() else { return };
            prefetch.order(order);
        }
        for order in received.try_iter() {
            prefetch.order(order);
        }
        let Some(news) = prefetch.work().transpose() else {
            continue;
        };
        // After an error the replica differs from the session.
        let is_last = news.is_err();
        if !answer(news) || is_last {
            return;
        }
    }
}
