//! A listener that completes TLS handshakes beside one another, so that a slow browser holds up no other.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::serve::Listener;
use palpate_transport::{PageStream, PageTls};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};

/// Handshakes at once; further connections wait in the queue of the operating system.
const HANDSHAKES_MAX: usize = 64;

/// Maximum duration of a handshake.
const HANDSHAKE_MAX: Duration = Duration::from_secs(10);

/// Pause after an error of the operating system, such as too many open files.
const PAUSE: Duration = Duration::from_millis(500);

/// Encrypted connections to an address.
pub(crate) struct HttpsListener {
    address: SocketAddr,
    opened: mpsc::Receiver<(PageStream, SocketAddr)>,
}

impl HttpsListener {
    /// Serves connections from a task of the present runtime.
    pub(crate) fn new(listener: TcpListener, tls: PageTls) -> io::Result<Self> {
        let address = listener.local_addr()?;
        let (sender, opened) = mpsc::channel(1);
        tokio::spawn(listen(listener, tls, sender));
        Ok(Self { address, opened })
    }
}

async fn listen(
    listener: TcpListener,
    tls: PageTls,
    opened: mpsc::Sender<(PageStream, SocketAddr)>,
) {
    let places = Arc::new(Semaphore::new(HANDSHAKES_MAX));
    while let Ok(place) = Arc::clone(&places).acquire_owned().await {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = opened.closed() => return,
        };
        match accepted {
            Ok((stream, from)) => {
                tokio::spawn(shake((stream, from), tls.clone(), opened.clone(), place));
            }
            Err(error) => {
                tracing::debug!(%error, "a connection was not accepted");
                tokio::time::sleep(PAUSE).await;
            }
        }
    }
}

async fn shake(
    (stream, from): (TcpStream, SocketAddr),
    tls: PageTls,
    opened: mpsc::Sender<(PageStream, SocketAddr)>,
    _place: OwnedSemaphorePermit,
) {
    match tokio::time::timeout(HANDSHAKE_MAX, tls.accept(stream)).await {
        Ok(Ok(stream)) => {
            // The server is gone when this fails.
            let _ = opened.send((stream, from)).await;
        }
        Ok(Err(error)) => tracing::debug!(%from, %error, "no TLS handshake"),
        Err(_) => tracing::debug!(%from, "the TLS handshake took too long"),
    }
}

impl Listener for HttpsListener {
    type Io = PageStream;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (PageStream, SocketAddr) {
        match self.opened.recv().await {
            Some(accepted) => accepted,
            // The task ends only with this listener.
            None => std::future::pending().await,
        }
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        Ok(self.address)
    }
}
