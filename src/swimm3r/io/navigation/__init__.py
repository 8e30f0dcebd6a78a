"""Navigation of vehicles: CSV, NMEA, Matisse .dim2, TUM, EXIF GPS, .srt files and ROS bags to one record."""
