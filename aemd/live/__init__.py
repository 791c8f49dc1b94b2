"""The live view: what the running acquisition shows to browsers, to Prometheus, to a terminal and to Foxglove.

    pipeline ──write──> Inbox ──take──> Feed ──> History ──frames──> Server ──> browsers, status, watch, Prometheus
     its thread         bounded         its thread                   a thread a client

Nothing here can slow the acquisition: `Inbox.write` appends to a bounded queue and returns, whatever happens behind it.
"""
