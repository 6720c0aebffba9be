"""Jones terms: gains, feeds, element and station beams, parallactic rotation, and chains of them."""
