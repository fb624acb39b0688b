//! The thread that makes cuts while the replica's goes on serving the hand.

use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};

use palpate_transport::threads::{self, ThreadClass};

use super::{Ahead, CutNews, CutOrder, ReplicaError};

/// A thread that makes cuts in the order of the log. It ends with this.
pub(crate) struct AheadThread {
    orders: Sender<CutOrder>,
    news: Receiver<Result<CutNews, ReplicaError>>,
}

impl AheadThread {
    pub(crate) fn spawn(ahead: Ahead) -> std::io::Result<Self> {
        let (orders, ordered) = channel();
        let (tell, news) = channel();
        threads::spawn(ThreadClass::Background, "cuts", move || {
            serve(ahead, &ordered, &tell);
        })?;
        Ok(Self { orders, news })
    }

    /// Has something done.
    pub(crate) fn order(&self, order: CutOrder) -> Result<(), ReplicaError> {
        self.orders.send(order).map_err(|_| ended())
    }

    /// The next result, if there is one; an error when the thread has ended by itself, so that no operation waits for
    /// ever.
    pub(crate) fn poll(&self) -> Result<Option<CutNews>, ReplicaError> {
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
    mut ahead: Ahead,
    ordered: &Receiver<CutOrder>,
    tell: &Sender<Result<CutNews, ReplicaError>>,
) {
    loop {
        if !ahead.can_work() {
            let Ok(order) = ordered.recv() else { return };
            ahead.order(order);
        }
        for order in ordered.try_iter() {
            ahead.order(order);
        }
        let Some(news) = ahead.work().transpose() else {
            continue;
        };
        // After an error the copy is not the session's any more.
        let is_last = news.is_err();
        if tell.send(news).is_err() || is_last {
            return;
        }
    }
}
